"""Value functions fitted to returns, with normalised targets and target networks where the run has them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from liir_common.config import AlgorithmConfig
from services.learner.algorithms.data import Data
from services.learner.algorithms.networks import Mlp, initial
from services.learner.algorithms.optim import Optimizer
from services.learner.algorithms.returns import explained_variance
from services.learner.algorithms.state import prefixed

_FORGET = 0.01
_LEAST_VARIANCE = 1e-6


class Normalizer:
    """Moving mean and standard deviation of returns (value normalisation as in MAPPO, Yu et al., 2022)."""

    def __init__(self, like: Tensor) -> None:
        self._moments = like.new_zeros(3)

    def tensors(self) -> dict[str, Tensor]:
        """The live state: moving averages of 1, G and G²."""
        return {"moments": self._moments}

    def update(self, returns: Tensor) -> None:
        """Take in the returns of a batch, of any shape."""
        batch = torch.stack([returns.new_ones(()), returns.mean(), returns.square().mean()])
        self._moments.lerp_(batch, _FORGET)

    def mean_and_std(self) -> tuple[Tensor, Tensor]:
        """Scalars; 0 and 1 before the first batch."""
        total, first, second = self._moments.unbind()
        if total == 0:
            return first, torch.ones_like(first)
        mean = first / total
        return mean, (second / total - mean**2).clamp_min(_LEAST_VARIANCE).sqrt()


class Critic:
    """A value function with its optimiser; values start at zero.

    `network` maps its inputs of the M team rows, [M, ...], to [M, k]: k = 1 value for the team or k = n
    values, one per agent. COMA's has one per action as well.
    """

    def __init__(
        self, network: Mlp, config: AlgorithmConfig, seed: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        self._config = config
        self._network = network
        self._parameters = initial(network, 0.0, config.orthogonal_init, seed, device, dtype)
        self._target = self._parameters.clone() if config.target_interval else self._parameters
        self._updates = torch.zeros((), dtype=torch.int64)
        self._optimizer = Optimizer(self._parameters, config.critic_optimizer)
        self._normalizer = Normalizer(self._parameters)

    def tensors(self) -> dict[str, Tensor]:
        """The live state."""
        own = {"parameters": self._parameters, "updates": self._updates} | self._normalizer.tensors()
        if self._config.target_interval:
            own["target"] = self._target
        return own | prefixed("optimizer", self._optimizer.tensors())

    @property
    def size(self) -> int:
        """Number of parameters that are trained."""
        return self._parameters.numel()

    def values(self, data: Data, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """V and the V̄ that returns are built from, both [B, T+1, k]: the live and the target network's."""
        live, target = self.outputs(inputs)
        return data.team(live), data.team(target)

    @torch.no_grad()
    def outputs(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """What the live and the target network make of `inputs`."""
        live = self._outputs(self._parameters, inputs)
        return live, self._outputs(self._target, inputs) if self._config.target_interval else live

    def _outputs(self, parameters: Tensor, inputs: Tensor) -> Tensor:
        mean, std = self._normalizer.mean_and_std()
        return mean + std * self._network(parameters, inputs)

    def fit(self, data: Data, inputs: Tensor, returns: Tensor, name: str) -> dict[str, Tensor]:
        """Regress the values of the played steps on `returns` [B, T, k]; see `regress`."""
        played = inputs[: data.played]
        return self.regress(lambda outputs: outputs, played, returns[data.filled.bool()], name)

    def regress(
        self, pick: Callable[[Tensor], Tensor], inputs: Tensor, target: Tensor, name: str
    ) -> dict[str, Tensor]:
        """Full-batch steps on the mean square of what `pick` takes from the outputs, less `target`.

        The figures, named after `name`, are those before the first step.
        """
        if self._config.normalize_values:
            self._normalizer.update(target)
        mean, std = self._normalizer.mean_and_std()
        target = (target - mean) / std
        for epoch in range(self._config.critic_epochs):
            parameters = self._parameters.detach().requires_grad_()
            prediction = pick(self._network(parameters, inputs))
            loss = (prediction - target).square().mean()
            if epoch == 0:
                figures = {
                    f"{name}_loss": loss.detach(),
                    f"{name}_explained_variance": explained_variance(prediction.detach(), target),
                }
            (gradient,) = torch.autograd.grad(loss, parameters)
            self._optimizer.ascend(-gradient)
        self._updates += 1
        if self._config.target_interval and int(self._updates) % self._config.target_interval == 0:
            self._target.copy_(self._parameters)
        return figures
