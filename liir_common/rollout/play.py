"""From the configuration of an environment to what plays it."""

from __future__ import annotations

import importlib
from typing import Any

from pettingzoo import ParallelEnv

from liir_common import seeds
from liir_common.battle.env import battle_spec, parallel_env
from liir_common.config import EnvConfig
from liir_common.errors import ConfigError
from liir_common.rollout import changes
from liir_common.rollout.fused import FusedPlayer
from liir_common.rollout.loop import Env, LoopPlayer, loop_spec
from liir_common.rollout.player import Player
from liir_common.rollout.policy import random_weights
from liir_common.smac import SmacEnv
from liir_common.types import EnvSpec, Exploration, Ticket


def env_spec(env: EnvConfig) -> EnvSpec:
    """What the configured environment looks like from outside.

    Raises:
        ConfigError: the map or an option is unknown, SMAC or the factory cannot be imported, or the
            factory does not return a ParallelEnv.
    """
    try:
        if env.kind == "battle":
            return battle_spec(env.map, **env.options)
        return loop_spec(_make(env), _name(env), env.options)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"env: {error}") from None


def make_player(env: EnvConfig, policy_hidden: int = 64, fused: bool = True) -> Player:
    """A player for policies with `policy_hidden` units; `fused=False` steps a battle in Python as well.

    Raises:
        ConfigError, ValueError: as `env_spec`.
    """
    if env.kind != "battle":
        game = _make(env)
        return LoopPlayer(game, loop_spec(game, _name(env), env.options), policy_hidden)
    options: dict[str, Any] = dict(env.options)
    if fused:
        return FusedPlayer(env.map, options, policy_hidden)
    return LoopPlayer(parallel_env(env.map, **options), env_spec(env), policy_hidden)


def _name(env: EnvConfig) -> str:
    return env.factory if env.kind == "pettingzoo" else f"{env.kind}/{env.map}"


def _make(env: EnvConfig) -> Env:
    return SmacEnv(env.map, **env.options) if env.kind == "smac" else _made_by_factory(env)


def _made_by_factory(env: EnvConfig) -> Env:
    module, colon, function = env.factory.partition(":")
    if not (module and colon and function):
        raise ConfigError(f"env.factory: wanted module:function, got {env.factory!r}")
    try:
        factory = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"env.factory: cannot import {env.factory!r}: {error}") from error
    try:
        game = factory(**env.options)
    except TypeError as error:
        raise ConfigError(
            f"env.factory: {env.factory!r} does not work with env.options {env.options}: {error}"
        ) from error
    if not isinstance(game, ParallelEnv):
        raise ConfigError(f"env.factory: {env.factory!r} wants to return a ParallelEnv, got {game!r}")
    return game


def warm_up(env: EnvConfig) -> None:
    """Compile all that playing `env` and sending it needs, into numba's cache, by playing one episode."""
    player = make_player(env)
    player.load(random_weights(player.spec, hidden=64, seed=0))
    seed = seeds.episode_seed(0, seeds.EVALUATION, 0)
    trajectory = player.play(Ticket(0, 0, seed, Exploration.SOFTMAX_FLOOR, epsilon=0.5))
    changes.pack(trajectory.obs)
