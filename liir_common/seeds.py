"""Seeds: what each random stream of a run starts from, derived in plain Python integers.

`liir_common.rng` has the same functions for compiled code; both must agree (tests/unit/test_rng.py).
"""

GOLDEN = 0x9E3779B97F4A7C15
MIX_1, MIX_2 = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
_MASK = (1 << 64) - 1

# What a seed is for; streams of different domains never meet.
TRAINING, EVALUATION, BATTLE, POLICY, LEARNER = 1, 2, 3, 4, 5


def mix(x: int) -> int:
    """SplitMix64's finaliser: a bijection on 64 bits in which every input bit moves every output bit."""
    x = ((x ^ (x >> 30)) * MIX_1) & _MASK
    x = ((x ^ (x >> 27)) * MIX_2) & _MASK
    return x ^ (x >> 31)


def derive(seed: int, index: int) -> int:
    """Seed of the sub-stream `index` of `seed`: an integer in [0, 2**64)."""
    return mix((mix((seed + GOLDEN) & _MASK) + index * GOLDEN) & _MASK)


def episode_seed(run_seed: int, domain: int, episode_id: int) -> int:
    """Seed of episode `episode_id` of a run: it depends on nothing else."""
    return derive(derive(run_seed, domain), episode_id)


def evaluation_seed(run_seed: int, checkpoint: int, index: int) -> int:
    """Seed of a test episode of a checkpoint, greedy or sampled."""
    return derive(episode_seed(run_seed, EVALUATION, checkpoint), index)
