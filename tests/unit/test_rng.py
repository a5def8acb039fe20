"""Compiled random streams: the same numbers as plain Python, apart from each other, uniform; and
never those of a version of the package that is gone."""

import hashlib
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

from liir_common import build, rng, seeds
from services.learner.algorithms import gru_compiled

EDGES = [0, 1, 2, 12345, 2**31, 2**63 - 1, 2**63, 2**64 - 1]


@pytest.mark.parametrize("seed", EDGES)
@pytest.mark.parametrize("index", [0, 1, 5, 2**40, 2**64 - 1])
def test_compiled_seeds_are_those_of_plain_python(seed: int, index: int) -> None:
    assert int(rng.derive(np.uint64(seed), np.uint64(index))) == seeds.derive(seed, index)
    assert int(rng.mix(np.uint64(seed))) == seeds.mix(seed)


def test_first_draws_are_the_published_ones() -> None:
    # Outputs of SplitMix64 from seed 1234567, as published with several reference implementations.
    stream = np.array([1234567], np.uint64)
    drawn = [int(rng.next_u64(stream)) for _ in range(3)]
    assert drawn == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_draw_k_depends_on_seed_and_k_only() -> None:
    stream = np.array([99], np.uint64)
    drawn = [int(rng.next_u64(stream)) for _ in range(10)]
    assert drawn == [seeds.mix((99 + (k + 1) * seeds.GOLDEN) % 2**64) for k in range(10)]


def test_streams_of_domains_and_episodes_never_meet() -> None:
    domains = [seeds.TRAINING, seeds.EVALUATION, seeds.BATTLE, seeds.POLICY, seeds.LEARNER]
    starts = [seeds.episode_seed(1, domain, episode) for domain in domains for episode in range(40)]
    streams = [np.array([start], np.uint64) for start in starts]
    drawn = [int(rng.next_u64(stream)) for stream in streams for _ in range(1000)]
    assert len(set(drawn)) == len(drawn)


def test_seeds_of_runs_differ() -> None:
    of_runs = {
        seeds.episode_seed(run, seeds.TRAINING, episode) for run in range(100) for episode in range(100)
    }
    assert len(of_runs) == 10_000


def test_uniform_is_uniform() -> None:
    stream = np.array([seeds.derive(7, seeds.POLICY)], np.uint64)
    draws = np.array([rng.uniform(stream) for _ in range(50_000)])
    assert draws.min() >= 0
    assert draws.max() < 1
    counts = np.histogram(draws, 100, (0, 1))[0]
    chi_square = ((counts - 500) ** 2 / 500).sum()
    # 99 degrees of freedom: 99.99 % of uniform samples are below 160.
    assert chi_square < 160
    assert abs(np.corrcoef(draws[:-1], draws[1:])[0, 1]) < 4 / np.sqrt(len(draws))


def test_code_compiled_before_a_change_of_another_file_is_not_used(tmp_path: Path) -> None:
    # Numbers of seeds.py are compiled into the kernels of rng.py, whose own file stays as it is.
    package = tmp_path / "liir_common"
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(rng.__file__).parent, package, ignore=ignored)
    code = (
        "import numpy as np; from liir_common import rng, seeds;"
        "print(int(rng.mix(np.uint64(1))) == seeds.mix(1), rng.mix.stats.cache_hits.total())"
    )

    def run() -> str:
        environment = os.environ | {"PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        ).stdout

    assert run().split() == ["True", "0"]
    assert run().split() == ["True", "1"]
    source = (package / "seeds.py").read_text(encoding="utf-8")
    (package / "seeds.py").write_text(source.replace("0xBF58476D1CE4E5B9", "0xBF58476D1CE4E5BB"))
    assert run().split() == ["True", "0"]


def cache_stamps(module_name: str) -> set[str]:
    module = importlib.import_module(module_name)
    kernels = [value for value in vars(module).values() if isinstance(value, Dispatcher)]
    cached = [kernel for kernel in kernels if isinstance(kernel._cache, FunctionCache)]
    return {kernel._cache._impl.locator.get_source_stamp() for kernel in cached}


@pytest.mark.parametrize(
    "name",
    ["rng", "battle.engine", "battle.observation", "battle.policies", "rollout.policy", "rollout.dense"],
)
def test_every_cached_kernel_of_the_package_is_watched(name: str) -> None:
    assert cache_stamps(f"liir_common.{name}") == {build.source_digest()}


def test_kernels_of_the_learner_watch_their_own_file_and_what_they_take_from_the_package() -> None:
    module = Path(gru_compiled.__file__)
    own = hashlib.sha256(module.read_bytes()).hexdigest()
    stamps = cache_stamps("services.learner.algorithms.gru_compiled")
    # `add_product` among them is the package's.
    assert stamps == {build.source_digest(), build.source_digest() + own}
