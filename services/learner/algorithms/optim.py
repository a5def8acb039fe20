"""Gradient ascent on one flat parameter vector, with the derivative of a step by its gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from liir_common.config import OptimizerConfig

_BETA_1, _BETA_2 = 0.9, 0.999


@dataclass(frozen=True)
class Step:
    """A step θ' = θ + α·P(g) that was taken, P being the norm clip followed by the preconditioner."""

    gradient: Tensor
    """g [P], before the clip"""
    diagonal: Tensor
    """[P], α times the preconditioner, which counts as a constant"""
    clip: float
    """Norm at which g was clipped"""

    @property
    def norm(self) -> Tensor:
        """‖g‖, a scalar."""
        norm: Tensor = torch.linalg.vector_norm(self.gradient)
        return norm

    def transpose(self, v: Tensor) -> Tensor:
        """α·P'(g)ᵀ·v [P] for v = ∂J/∂θ' [P]: how J changes with g."""
        v = self.diagonal * v
        norm = self.norm
        if norm <= self.clip:
            return v
        unit = self.gradient / norm
        return (self.clip / norm) * (v - unit * (unit @ v))


class Optimizer:
    """RMSprop or Adam with a norm clip, ascending in place on `parameters` [P]."""

    def __init__(self, parameters: Tensor, config: OptimizerConfig) -> None:
        self._config = config
        self._parameters = parameters
        self._steps = torch.zeros((), dtype=torch.int64)
        self._square = torch.zeros_like(parameters)
        self._mean = torch.zeros_like(parameters if config.name == "adam" else parameters[:0])

    def tensors(self) -> dict[str, Tensor]:
        """The live state."""
        return {"steps": self._steps, "square": self._square, "mean": self._mean}

    def ascend(self, gradient: Tensor) -> Step:
        """Move the parameters along `gradient` [P] and describe the step."""
        config = self._config
        norm = torch.linalg.vector_norm(gradient)
        clipped = gradient * (config.clip / norm) if norm > config.clip else gradient
        self._steps += 1
        direction, weight = self._adam(clipped) if config.name == "adam" else self._rmsprop(clipped)
        self._parameters.addcmul_(direction, weight, value=config.lr)
        return Step(gradient, self._sensitivity(weight), config.clip)

    def _adam(self, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Direction m̂ and weight 1 / (√v̂ + eps) (Kingma and Ba, 2015)."""
        steps = int(self._steps)
        self._mean.lerp_(gradient, 1 - _BETA_1)
        self._square.mul_(_BETA_2).addcmul_(gradient, gradient, value=1 - _BETA_2)
        scale = (self._square / (1 - _BETA_2**steps)).sqrt_().add_(self._config.eps)
        return self._mean / (1 - _BETA_1**steps), scale.reciprocal_()

    def _rmsprop(self, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Direction g and weight 1 / (√v + eps)."""
        alpha = self._config.alpha
        self._square.mul_(alpha).addcmul_(gradient, gradient, value=1 - alpha)
        return gradient, self._square.sqrt().add_(self._config.eps).reciprocal_()

    def _sensitivity(self, weight: Tensor) -> Tensor:
        """α·∂(direction·weight)/∂g with the weight frozen; Adam's m̂ takes in a part of g only."""
        share = (1 - _BETA_1) / (1 - _BETA_1 ** int(self._steps)) if self._config.name == "adam" else 1.0
        return weight * (self._config.lr * share)
