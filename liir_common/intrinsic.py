"""The learned intrinsic reward r_in(η; s_i, u_i) of a frozen checkpoint, without torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from liir_common.checkpoint import Manifest, section
from liir_common.errors import ConfigError
from liir_common.types import FloatArray, Weights


class IntrinsicReward:
    """FC - ReLU - FC - ReLU - FC on (observation, one-hot agent id), squashed to ± bound."""

    def __init__(self, weights: Weights, bound: float) -> None:
        """Use the parameters that `Algorithm.intrinsic` gives out, and `AlgorithmConfig.r_in_bound`."""
        self._weights = weights
        self._bound = np.float32(bound)

    @classmethod
    def from_checkpoint(
        cls, manifest: Manifest, tensors: Mapping[str, NDArray[np.float32]]
    ) -> IntrinsicReward:
        """From what `CheckpointClient.get`, or `CheckpointStore.read` and `unpack`, return.

        Raises:
            ConfigError: the checkpoint's method has no intrinsic reward.
        """
        weights, algorithm = section(tensors, "intrinsic"), manifest.config["algorithm"]
        if not weights:
            raise ConfigError(
                f"checkpoint {manifest.episode} of run {manifest.run_id} was trained with "
                f"{algorithm['name']}, which has no intrinsic reward; name one of a liir run"
            )
        return cls(weights, algorithm["r_in_bound"])

    def __call__(self, obs: FloatArray) -> FloatArray:
        """r_in [..., n, A] of every action, available or not, for observations [..., n, O].

        What it gives for a dead agent means nothing: in training the dead get none.
        """
        ids = np.broadcast_to(np.eye(obs.shape[-2], dtype=np.float32), (*obs.shape[:-1], obs.shape[-2]))
        x = np.concatenate([obs, ids], -1)
        for layer in ("fc1", "fc2"):
            x = np.maximum(self._affine(layer, x), 0)
        squashed: FloatArray = np.tanh(self._affine("fc3", x) / self._bound)
        return self._bound * squashed

    def _affine(self, layer: str, x: FloatArray) -> FloatArray:
        return x @ self._weights[f"{layer}.weight"].T + self._weights[f"{layer}.bias"]
