"""A frozen policy as an ONNX graph, for programs that have neither Python nor this project."""

from __future__ import annotations

import json

import numpy as np

from liir_common import checkpoint
from liir_common.checkpoint import Manifest
from liir_common.config import AlgorithmConfig
from liir_common.errors import ConfigError
from liir_common.rollout.policy import pack
from liir_common.types import Weights

# Initializers are called as in `rollout.policy.Policy`; "no last action", -1, is a first row of fc1_action.
_GRAPH = """
<ir_version: 8, opset_import: ["" : 17]>
policy (
  float[batch, {n}, {obs}] observations, int64[batch, {n}] last_actions,
  bool[batch, {n}, {actions}] action_mask, float[batch, {n}, {hidden}] hidden
) => (
  int64[batch, {n}] actions, float[batch, {n}, {actions}] {outputs}, float[batch, {n}, {hidden}] next_hidden
) {{
  one = Constant <value_int: int = 1> ()
  row = Add(last_actions, one)
  of_action = Gather(fc1_action, row)
  of_obs = MatMul(observations, fc1_obs)
  of_both = Add(of_obs, of_action)
  of_all = Add(of_both, fc1_agent)
  features = Relu(of_all)
  x = MatMul(features, gru_input)
  x_biased = Add(x, gru_input_bias)
  x_r, x_z, x_n = Split <axis = -1> (x_biased)
  h = MatMul(hidden, gru_hidden)
  h_biased = Add(h, gru_hidden_bias)
  h_r, h_z, h_n = Split <axis = -1> (h_biased)
  sum_r = Add(x_r, h_r)
  reset = Sigmoid(sum_r)
  sum_z = Add(x_z, h_z)
  update = Sigmoid(sum_z)
  reset_n = Mul(reset, h_n)
  sum_n = Add(x_n, reset_n)
  new = Tanh(sum_n)
  change = Sub(hidden, new)
  kept = Mul(update, change)
  next_hidden = Add(new, kept)
  out = MatMul(next_hidden, fc2)
  out_biased = Add(out, fc2_bias)
  {outputs} = Where(action_mask, out_biased, minus_infinity)
  actions = ArgMax <axis = -1, keepdims = 0> ({outputs})
}}
"""


def to_onnx(manifest: Manifest, tensors: Weights) -> bytes:
    """The ONNX file of a checkpoint's policy: one decision of a batch of teams.

    Inputs, for n agents, A actions, O observation values and H hidden units:
        observations [batch, n, O] float32; zeros for an agent that left.
        last_actions [batch, n] int64, -1 before the first step.
        action_mask [batch, n, A] bool, true where available; an agent that left has action 0 alone.
        hidden [batch, n, H] float32, zeros before the first step.
    Outputs:
        actions [batch, n] int64, the best available ones.
        logits, or with a value-based method q_values [batch, n, A]; minus infinity where unavailable.
        next_hidden [batch, n, H], the next step's `hidden`.

    Raises:
        ConfigError: the package onnx is not installed.
        ValueError: the tensors do not hold a policy of the manifest's sizes.
    """
    try:
        import onnx
    except ImportError:
        raise ConfigError('an export wants onnx: pip install "liir-service[export]"') from None
    spec = manifest.spec
    algorithm = AlgorithmConfig.model_validate(manifest.config["algorithm"])
    policy = pack(checkpoint.section(tensors, "policy"), spec, algorithm.policy_hidden)
    model = onnx.parser.parse_model(
        _GRAPH.format(
            n=spec.n_agents,
            obs=spec.obs_dim,
            actions=spec.n_actions,
            hidden=algorithm.policy_hidden,
            outputs="q_values" if algorithm.value_based else "logits",
        )
    )
    constants = {
        "fc1_obs": policy.fc1_obs,
        "fc1_action": np.pad(policy.fc1_action, ((1, 0), (0, 0))),
        "fc1_agent": policy.fc1_agent,
        "gru_input": policy.gru_input,
        "gru_input_bias": policy.gru_input_bias,
        "gru_hidden": policy.gru_hidden,
        "gru_hidden_bias": policy.gru_hidden_bias,
        "fc2": policy.fc2,
        "fc2_bias": policy.fc2_bias,
        "minus_infinity": np.array(-np.inf, np.float32),
    }
    model.graph.initializer.extend(onnx.numpy_helper.from_array(a, name) for name, a in constants.items())
    model.producer_name = "liir-service"
    about = {"env_spec": json.dumps(manifest.env_spec), "method": algorithm.name, "run_id": manifest.run_id}
    about |= {"episode": str(manifest.episode), "sha256": manifest.sha256, "git_commit": manifest.git_commit}
    onnx.helper.set_model_props(model, about)
    onnx.checker.check_model(model, full_check=True)
    data: bytes = model.SerializeToString()
    return data
