"""How fast a learner step is, beside what its matrix products alone would take."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from liir_common.config import AlgorithmConfig
from liir_common.types import Batch, EnvSpec, Trajectory
from services.learner.algorithms import make_algorithm
from services.learner.memory import keep_memory

Layout = tuple[tuple[int, ...], tuple[int, ...]]
"""Sizes and strides of a matrix"""
_FACTORS = {"mm": slice(0, 2), "bmm": slice(0, 2), "addmm": slice(1, 3), "addmm_": slice(1, 3)}


def bench_learner(
    algorithm: AlgorithmConfig,
    spec: EnvSpec,
    episodes: int = 32,
    steps: int = 25,
    threads: Sequence[int] = (1, 2),
    repeats: int = 30,
) -> dict[str, Any]:
    """Time learner steps on the CPU against their floor, the time of their matrix products alone.

    The products, with sizes and memory layouts, are recorded from a real update and run again by themselves,
    in float32, with the same threads in the same run. Floating point operations are two per multiply-add.

    Returns:
        env_steps and flops of the batch, and under "threads" for each count the medians update_ms, cpu_ms
        (the same in processor time) and floor_ms; ratio, update over floor; matmul_gflops, the rate of the
        products, and square_gflops, that of a 1024 x 1024 product.
    """
    batch = synthetic_batch(spec, episodes, steps, seed=0)
    learner = make_algorithm(spec, algorithm, 0, torch.device("cpu"))
    # In float64 every product is torch's, those that are compiled in float32 as well.
    recorded = make_algorithm(spec, algorithm, 0, torch.device("cpu"), torch.float64)
    recorded.update(batch)
    with _Products() as products:
        recorded.update(batch)
    flops = sum(_flops(a, b) * times for (a, b), times in products.seen.items())
    before = torch.get_num_threads()
    keep_memory()
    results = {}
    for count in threads:
        torch.set_num_threads(count)
        update, cpu = _median_seconds(lambda: learner.update(batch), repeats)
        floor = sum(_product_seconds(a, b, repeats) * times for (a, b), times in products.seen.items())
        square: Layout = ((1024, 1024), (1024, 1))
        results[count] = {
            "update_ms": update * 1e3,
            "cpu_ms": cpu * 1e3,
            "floor_ms": floor * 1e3,
            "ratio": update / floor,
            "matmul_gflops": flops / floor / 1e9,
            "square_gflops": _flops(square, square) / _product_seconds(square, square, repeats) / 1e9,
        }
    torch.set_num_threads(before)
    return {"env_steps": batch.env_steps, "flops": flops, "threads": results}


class _Products(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the matrix products that are computed while it is active."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.seen: Counter[tuple[Layout, Layout]] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name in _FACTORS:
            a, b = args[_FACTORS[name]]
            self.seen[(tuple(a.shape), a.stride()), (tuple(b.shape), b.stride())] += 1
        return func(*args, **(kwargs or {}))


def _flops(a: Layout, b: Layout) -> int:
    return 2 * int(np.prod(a[0])) * b[0][-1]


def _product_seconds(a: Layout, b: Layout, repeats: int) -> float:
    left, right = (torch.empty_strided(*layout).normal_() for layout in (a, b))
    out = left @ right
    return _median_seconds(lambda: torch.matmul(left, right, out=out), repeats)[0]


def _median_seconds(run: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median wall and processor time of a call."""
    run()
    wall, cpu = [], []
    for _ in range(repeats):
        start = time.perf_counter(), time.process_time()
        run()
        wall.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    return statistics.median(wall), statistics.median(cpu)


def synthetic_batch(
    spec: EnvSpec, episodes: int, steps: int, seed: int, policy_version: int = 0, epsilon: float = 0.1
) -> Batch:
    """Random episodes of about `steps` steps (standard deviation a fifth) played by the uniform policy.

    Every other agent dies, uniformly within the second half of its episode; one episode in five runs into
    the limit.
    """
    rng = np.random.default_rng(seed)
    lengths = np.clip(rng.normal(steps, steps / 5, episodes).round(), 2, spec.episode_limit).astype(int)
    trajectories = [_episode(spec, i, int(length), rng, policy_version) for i, length in enumerate(lengths)]
    return Batch.from_trajectories(trajectories, epsilon)


def _episode(spec: EnvSpec, number: int, length: int, rng: np.random.Generator, version: int) -> Trajectory:
    n, a = spec.n_agents, spec.n_actions
    death = np.where(rng.random(n) < 0.5, rng.integers(length // 2 + 1, length + 1, n), length + 1)
    alive = np.arange(length + 1)[:, None] < death
    mask = rng.random((length + 1, n, a)) < 0.7
    mask[..., 0] = ~alive
    mask[~alive, 1:] = False
    mask[alive, 1] = True
    actions = np.where(mask, rng.random(mask.shape), -1).argmax(-1)[:length]
    truncated = bool(rng.random() < 0.2)
    return Trajectory(
        episode_id=number,
        policy_version=version,
        obs=(rng.normal(size=(length + 1, n, spec.obs_dim)) * alive[..., None]).astype(np.float32),
        state=rng.normal(size=(length + 1, spec.state_dim)).astype(np.float32),
        mask=mask,
        alive=alive,
        actions=actions.astype(np.int16),
        log_mu=-np.log(mask[:length].sum(-1)).astype(np.float32),
        reward=rng.random(length).astype(np.float32),
        terminated=not truncated,
        truncated=truncated,
        info=dict.fromkeys(spec.info_keys, 0.0),
    )
