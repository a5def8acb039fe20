"""`python -m tests.faults.many_actors ADDRESS COUNT`: actors as threads of one process, without Ray."""

from __future__ import annotations

import sys
import threading

from liir_common.client import learners_config
from liir_common.config import PLAINTEXT
from liir_common.rollout.play import warm_up
from liir_common.rpc.tokens import Role
from services.actor.rollout_actor import RolloutActor

if __name__ == "__main__":
    address, count = sys.argv[1], int(sys.argv[2])
    config = learners_config(address, (), PLAINTEXT, Role.ACTOR)
    warm_up(config.env)
    actors = [RolloutActor(f"actor-{number:03d}", 0, address, config.tree(), {}) for number in range(count)]
    threads = [threading.Thread(target=actor.run) for actor in actors]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
