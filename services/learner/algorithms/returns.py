"""Returns, advantages and their normalisation, over batches [B, T] of episodes that are filled prefixes."""

from __future__ import annotations

import torch
from torch import Tensor

# Keeps quotients finite, and the square root differentiable, where all entries are equal.
_LEAST_VARIANCE = 1e-10


def lambda_return(reward: Tensor, value: Tensor, filled: Tensor, gamma: float, gae_lambda: float) -> Tensor:
    """TD(λ_g) returns G [B, T, n]; G - V is GAE (Schulman et al., 2016) and at λ_g = 0 the TD(0) error.

    G_t = V_t + Σ_k≥t (γ·λ_g)^(k-t)·δ_k over the steps of the same episode, δ_k = r_k + γ·V_k+1 - V_k. The
    sum is one matrix product, which autograd differentiates as it is.

    Args:
        reward: [B, T, n]
        value: [B, T+1, n]; zero after an end without bootstrapping, so that no end needs a factor here
        filled: [B, T], 1 for steps that were played and else 0
    """
    delta = (reward + gamma * value[:, 1:] - value[:, :-1]) * filled.unsqueeze(-1)
    step = torch.arange(filled.shape[1], device=filled.device)
    distance = (step - step.unsqueeze(1)).clamp(min=0)
    decay = ((gamma * gae_lambda) ** distance.to(delta.dtype)).triu()
    # Contracting over time with all episodes side by side makes one large product of it.
    summed: Tensor = torch.tensordot(delta, decay, ([1], [1]))
    return value[:, :-1] + summed.transpose(1, 2)


def normalize(advantage: Tensor, weight: Tensor) -> Tensor:
    """`advantage` [R] to mean 0 and standard deviation 1 over the entries of `weight` [R] (Σ ≥ 1)."""
    count = weight.sum()
    centred = advantage - (weight * advantage).sum() / count
    variance = (weight * centred**2).sum() / count
    return centred * torch.rsqrt(variance + _LEAST_VARIANCE)


def explained_variance(prediction: Tensor, target: Tensor) -> Tensor:
    """1 - Var(target - prediction) / Var(target) over all entries: 1 is perfect, 0 as good as the mean."""
    error = (target - prediction).var(correction=0)
    return 1 - error / target.var(correction=0).clamp_min(_LEAST_VARIANCE)
