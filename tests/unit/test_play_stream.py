"""What waits to be sent on a stream between an actor and the learner goes together, in the right order."""

from __future__ import annotations

import asyncio
import queue
from dataclasses import replace

import pytest

from liir_common import config
from liir_common.errors import ConfigError
from liir_common.rpc.gen.liir.v1 import rollout_pb2, tensor_pb2
from liir_common.rpc.requests import Outgoing, gather, put_together
from services.learner.rollout_service import ActorStream, RolloutService
from tests.samples import SPEC


def sent(stream: ActorStream) -> list[rollout_pb2.PlayResponse]:
    async def collect() -> list[rollout_pb2.PlayResponse]:
        return [response async for response in stream.responses()]

    return asyncio.run(asyncio.wait_for(collect(), 10))


def test_acks_a_policy_and_its_tickets_are_one_message() -> None:
    stream = ActorStream("a")
    stream.ack(3)
    stream.policy(rollout_pb2.Policy(version=1))
    stream.ticket(rollout_pb2.Ticket(episode_id=7, policy_version=1))
    stream.ack(4)
    stream.ticket(rollout_pb2.Ticket(episode_id=8, policy_version=1))
    stream.end()
    (message,) = sent(stream)
    assert [ack.episode_id for ack in message.acks] == [3, 4]
    assert [ticket.episode_id for ticket in message.tickets] == [7, 8]
    assert message.policy.version == stream.policy_version == 1


def test_a_policy_never_overtakes_tickets_of_the_one_before() -> None:
    stream = ActorStream("a")
    for version in (1, 2):
        stream.policy(rollout_pb2.Policy(version=version))
        stream.ticket(rollout_pb2.Ticket(policy_version=version))
    stream.drain(rollout_pb2.Drain(reason="done"))
    stream.end()
    first, second = sent(stream)
    assert [first.policy.version, second.policy.version] == [1, 2]
    assert [first.tickets[0].policy_version, second.tickets[0].policy_version] == [1, 2]
    assert not first.HasField("drain")
    assert second.drain.reason == "done"


def test_the_error_that_ends_a_stream_comes_after_all_else() -> None:
    stream = ActorStream("a")
    stream.ack(1)
    stream.end(ValueError("broken"))
    stream.end()

    async def read() -> None:
        responses = stream.responses()
        assert (await anext(responses)).acks[0].episode_id == 1
        with pytest.raises(ValueError, match="broken"):
            await anext(responses)

    asyncio.run(asyncio.wait_for(read(), 10))


def trajectory(episode: int, size: int = 0) -> rollout_pb2.PlayRequest:
    obs = tensor_pb2.Tensor(data=bytes(size))
    return rollout_pb2.PlayRequest(trajectories=[rollout_pb2.Trajectory(episode_id=episode, obs=obs)])


def episodes(outgoing: Outgoing) -> list[list[int]]:
    return [[t.episode_id for t in request.trajectories] for request in put_together(outgoing)]


def test_requests_that_wait_are_put_together_up_to_a_size() -> None:
    outgoing: Outgoing = queue.SimpleQueue()
    outgoing.put(rollout_pb2.PlayRequest(hello=rollout_pb2.Hello(actor_id="a")))
    outgoing.put(trajectory(1))
    outgoing.put(trajectory(2, size=2 << 20))
    outgoing.put(trajectory(3))
    outgoing.put(trajectory(4))
    outgoing.put(None)
    assert episodes(outgoing) == [[1, 2], [3, 4]]
    outgoing.put(None)
    assert episodes(outgoing) == []


def test_what_is_played_in_one_go_is_gathered_up_to_a_size() -> None:
    """A message is sent as soon as it is large enough, not when all is played."""
    played = iter([trajectory(1), trajectory(2, size=2 << 20), trajectory(3)])
    requests = gather(request.trajectories[0] for request in played)
    assert [t.episode_id for t in next(requests).trajectories] == [1, 2]
    assert next(played).trajectories[0].episode_id == 3
    assert list(requests) == []


def test_a_game_whose_episodes_no_message_can_hold_is_refused() -> None:
    big = replace(SPEC, obs_dim=84 * 84 * 4, n_agents=8, episode_limit=60)
    with pytest.raises(ConfigError, match="at most 31 MiB, one of 60 steps would have 53"):
        RolloutService(config.load(None), big, 0, queue.SimpleQueue())
