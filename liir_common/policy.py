"""A frozen policy that plays any PettingZoo parallel environment of the sizes that it was trained on."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from liir_common import checkpoint, seeds
from liir_common.checkpoint import Manifest
from liir_common.config import AlgorithmConfig
from liir_common.replay.load import load_checkpoint
from liir_common.rollout.loop import NO_OP, Env, check_seen, read_observation, team_sizes
from liir_common.rollout.policy import MODES, Choice, act, pack
from liir_common.types import Weights


class Policy:
    """Chooses the actions of a whole team and remembers the episode: one episode at a time."""

    def __init__(self, manifest: Manifest, tensors: Weights, sampled: bool = False) -> None:
        """Use a checkpoint as `CheckpointClient.get` returns it.

        It takes the best action every time; if `sampled`, what `AlgorithmConfig.frozen_choice` has.

        Raises:
            ValueError: the tensors do not hold a policy of the manifest's sizes.
        """
        weights, spec = checkpoint.section(tensors, "policy"), manifest.spec
        algorithm = AlgorithmConfig.model_validate(manifest.config["algorithm"])
        self.manifest = manifest
        self._sizes = (spec.n_agents, spec.obs_dim, spec.n_actions)
        self._exploration, self._epsilon = algorithm.frozen_choice(sampled)
        self._network = pack(weights, spec, algorithm.policy_hidden)
        self._hidden = np.zeros((spec.n_agents, algorithm.policy_hidden), np.float32)
        self._obs = np.zeros((spec.n_agents, spec.obs_dim), np.float32)
        self._mask = np.zeros((spec.n_agents, spec.n_actions), np.bool_)
        self._chosen = np.zeros(spec.n_agents, np.int64)
        self._log_mu = np.zeros(spec.n_agents, np.float32)

    @classmethod
    def load(cls, path: str | Path, sampled: bool = False) -> Policy:
        """The policy of a checkpoint's .safetensors file, whose .json lies beside it; `sampled` as above.

        Warns if this build simulates battles differently from the one that trained it.

        Raises:
            ConfigError: one of the two files cannot be read.
            CorruptError: they do not belong together, or are no checkpoint.
        """
        return cls(*load_checkpoint(Path(path)), sampled=sampled)

    def begin(self, env: Env, seed: int | None = None) -> None:
        """Forget the last episode; the next decisions are for the one that `env.reset(seed)` begins.

        Args:
            env: agents, observations and action masks as docs/environments.md has them.
            seed: 64 bits, for what is drawn from the policy; None takes a random one.

        Raises:
            ValueError: the environment has other sizes than that of the training.
        """
        sizes = team_sizes(env, str(env))
        if sizes != self._sizes:
            wanted, got = (
                "{} agents, {} observation values, {} actions".format(*s) for s in (self._sizes, sizes)
            )
            raise ValueError(f"a policy trained on {self.manifest.spec.name} wants {wanted}; {env} has {got}")
        self._env, self._step = env, 0
        self._hidden[:] = 0
        self._chosen[:] = -1
        seed = secrets.randbits(64) if seed is None else seed
        stream = np.array([seeds.derive(seed, seeds.POLICY)], np.uint64)
        self._choice = Choice(stream, MODES[self._exploration], self._epsilon)

    def act(self, observations: Mapping[str, Any], infos: Mapping[str, Any]) -> dict[str, int]:
        """The next action of every agent in `env.agents`, from what `env.reset` or `env.step` returned.

        Raises:
            ValueError: an observation is not finite, or an agent has no available action.
        """
        for i, agent in enumerate(self._env.possible_agents):
            if agent in self._env.agents:
                self._obs[i], self._mask[i] = read_observation(observations[agent], infos[agent])
            else:
                self._obs[i], self._mask[i] = 0, np.arange(self._mask.shape[1]) == NO_OP
        check_seen(self._step, self._obs, self._mask)
        act(
            self._network,
            self._hidden,
            self._obs,
            self._chosen,
            self._mask,
            self._choice,
            self._chosen,
            self._log_mu,
        )
        self._step += 1
        actions = dict(zip(self._env.possible_agents, self._chosen.tolist(), strict=True))
        return {agent: actions[agent] for agent in self._env.agents}

    def play(self, env: Env, seed: int | None = None) -> Iterator[tuple[Any, ...]]:
        """Play one episode; after every step comes what `env.step` returned. Raises what the others raise."""
        self.begin(env, seed)
        observations, infos = env.reset(seed=seed)
        while env.agents:
            results = env.step(self.act(observations, infos))
            yield results
            observations, infos = results[0], results[-1]
