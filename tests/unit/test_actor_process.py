"""What the process of an actor does around its start."""

from __future__ import annotations

import subprocess
import sys

LIGHT = """
import sys
from services.actor.process import ActorProcess
print(sorted({"grpc", "numba", "numpy", "ray"} & sys.modules.keys()))
"""
STARTED = """
import gc
import services.actor.rollout_actor
from services.actor.process import ActorProcess

class Actor:
    def __init__(self, *args):
        print(args, gc.isenabled())

    def ready(self):
        return "node"

services.actor.rollout_actor.RolloutActor = Actor
print(ActorProcess(1, 2).ready(), gc.isenabled(), gc.get_freeze_count() > 0)
"""


def run(code: str) -> str:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return result.stdout


def test_it_imports_nothing_until_its_actor_is_wanted() -> None:
    assert run(LIGHT) == "[]\n"


def test_garbage_is_collected_again_once_the_actor_is_there() -> None:
    assert run(STARTED) == "(1, 2) False\nnode True True\n"
