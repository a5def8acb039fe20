"""A real learner process, spoken to over its real port by a test that plays the actor's part."""

from __future__ import annotations

import base64
import json
import queue
import re
import socket
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
import torch
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from typer.testing import CliRunner

from liir_common import checkpoint, seeds
from liir_common.build import build
from liir_common.cli import app
from liir_common.client import CheckpointClient, TrainingClient, learners_config
from liir_common.config import PLAINTEXT
from liir_common.errors import ConfigError, LiirError, MissingError, RefusedError, UnreachableError
from liir_common.files import read_table
from liir_common.policy import Policy
from liir_common.replay.load import find_checkpoint
from liir_common.rollout.play import make_player
from liir_common.rollout.player import Player
from liir_common.rpc import codec
from liir_common.rpc.channel import CHANNEL_OPTIONS, connect
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2, rollout_pb2, rollout_pb2_grpc, training_pb2
from liir_common.rpc.tokens import Role
from liir_common.types import Exploration, Ticket, Trajectory, Weights, policy_shapes
from services.evaluator.evaluator import Evaluator
from services.learner.algorithms import make_algorithm
from tests.e2e import service
from tests.faults.proxy import Proxy
from tests.grpcurl import grpcurl, needs_grpcurl

NO_STATS = rollout_pb2.ActorStats()
PLAYER = service.config("env.map=3m")


class Actor:
    """Speaks one stream, a message at a time."""

    def __init__(self, address: str, player: Player | None = None, **hello: object) -> None:
        self.player = player or make_player(PLAYER.env)
        self._channel = grpc.insecure_channel(address, options=CHANNEL_OPTIONS)
        self._outgoing: queue.SimpleQueue[rollout_pb2.PlayRequest | None] = queue.SimpleQueue()
        fields = {"actor_id": "test", "env_spec_hash": self.player.spec.hash, "build": build()} | hello
        self._outgoing.put(rollout_pb2.PlayRequest(hello=rollout_pb2.Hello(**fields)))
        stub = rollout_pb2_grpc.RolloutServiceStub(self._channel)
        self._responses = stub.Play(iter(self._outgoing.get, None), timeout=60)
        self._orders: deque[Ticket] = deque()
        self._acks: deque[int] = deque()

    def __enter__(self) -> Actor:
        return self

    def __exit__(self, *_: object) -> None:
        self.leave()
        self._channel.close()

    def ask(self, tickets: int = 1) -> None:
        self._outgoing.put(rollout_pb2.PlayRequest(ready=rollout_pb2.Ready(tickets=tickets)))

    def send(self, message: rollout_pb2.Trajectory) -> None:
        self._outgoing.put(rollout_pb2.PlayRequest(trajectories=[message]))

    def receive(self) -> rollout_pb2.PlayResponse:
        """The next message; its policy is loaded, its tickets and acks are kept."""
        response = next(self._responses)
        if response.HasField("policy"):
            self.player.load(codec.decode_policy(response.policy, policy_shapes(self.player.spec, 64)))
        self._orders.extend(map(codec.decode_ticket, response.tickets))
        self._acks.extend(ack.episode_id for ack in response.acks)
        return response

    def order(self) -> Ticket:
        """The next ticket."""
        while not self._orders:
            self.receive()
        return self._orders.popleft()

    def ack(self) -> int:
        """The episode that is confirmed next."""
        while not self._acks:
            self.receive()
        return self._acks.popleft()

    def play(self, ticket: Ticket) -> rollout_pb2.Trajectory:
        return codec.encode_trajectory(self.player.play(ticket), NO_STATS)

    def leave(self) -> None:
        """Half-close: nothing more will be sent."""
        self._outgoing.put(None)

    def rest(self) -> list[rollout_pb2.PlayResponse]:
        """All that comes until the stream ends."""
        return list(self._responses)

    def error(self) -> grpc.RpcError:
        with pytest.raises(grpc.RpcError) as caught:
            for _ in self._responses:
                pass
        return caught.value


class Recorder:
    """A real player that remembers what it played."""

    def __init__(self) -> None:
        self.player = make_player(PLAYER.env)
        self.spec = self.player.spec
        self.played: list[tuple[Ticket, Trajectory]] = []

    def load(self, weights: Weights) -> None:
        self.player.load(weights)

    def play(self, ticket: Ticket) -> Trajectory:
        trajectory = self.player.play(codec.decode_ticket(codec.encode_ticket(ticket)))
        self.played.append((ticket, trajectory))
        return trajectory


@pytest.fixture
def learner(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[tuple[str, Path]]:
    """Address and run directory of a learner whose batches have four episodes; more settings as parameter."""
    run_dir = tmp_path / "run"
    settings = (
        "training.batch_episodes=4",
        "training.checkpoint_interval=6",
        "training.total_env_steps=2000",
        *getattr(request, "param", ()),
    )
    process = service.start("learner", "--run-dir", str(run_dir), *service.arguments(settings))
    try:
        service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
        yield service.endpoints(run_dir)["address"], run_dir
    finally:
        process.terminate()
        service.finish(process)


def play_batches(address: str, batches: int) -> None:
    with Actor(address) as actor:
        actor.ask()
        for _ in range(4 * batches):
            actor.send(actor.play(actor.order()))
            actor.ack()


def test_an_evaluator_that_would_play_other_episodes_ends(learner: tuple[str, Path]) -> None:
    address, _ = learner
    other = make_player(service.config("env.map=8m").env)
    with pytest.raises(RefusedError, match=r"would play other episodes: wanted .* start it from"):
        Evaluator(address, PLAYER, other).run()


def test_play_stream(learner: tuple[str, Path]) -> None:
    """Hello, policy once per version, tickets in order, acks; a second copy is acked and changes nothing."""
    address, _ = learner
    with Actor(address) as actor, TrainingClient(address) as training:
        actor.ask(3)
        policy = actor.receive().policy
        assert policy.version == 0
        assert_begins_from_seed(policy)
        tickets = [actor.order() for _ in range(3)]
        assert [ticket.episode_id for ticket in tickets] == [0, 1, 2]
        assert tickets[2].seed == seeds.episode_seed(PLAYER.seed, seeds.TRAINING, 2)
        assert training.status().tickets_outstanding == 3
        actor.send(actor.play(tickets[0]))
        assert actor.ack() == 0
        tickets.append(actor.order())
        for ticket in tickets:
            actor.send(actor.play(ticket))
            assert actor.ack() == ticket.episode_id
        assert actor.order().policy_version == 1
        # Tickets of the next batch come while the step that moved the policy is still being made.
        service.wait_for(lambda: training.status().learner_step == 1, "the end of the step")
        assert training.status().episodes == 4


def assert_begins_from_seed(policy: rollout_pb2.Policy) -> None:
    """The policy of version 0 is what the run's seed makes of the method."""
    spec = make_player(PLAYER.env).spec
    seed = seeds.derive(PLAYER.seed, seeds.LEARNER)
    wanted = make_algorithm(spec, PLAYER.algorithm, seed, torch.device("cpu")).policy()
    got = codec.decode_policy(policy, policy_shapes(spec, 64))
    for name, array in wanted.items():
        # The learner makes them with another number of threads, which may round otherwise.
        np.testing.assert_allclose(got[name], array, rtol=0, atol=1e-5, err_msg=name)


def test_tickets_of_a_broken_stream_go_to_the_next_actor(learner: tuple[str, Path]) -> None:
    address, _ = learner
    with Actor(address) as actor:
        actor.ask(2)
        assert actor.order().episode_id == 0
    with TrainingClient(address) as training:
        service.wait_for(lambda: training.status().actors == 0, "the end of the stream at the learner")
    with Actor(address) as actor:
        actor.ask(1)
        assert actor.order().episode_id == 0


def test_a_silent_peer_is_noticed_and_its_ticket_played_within_fifteen_seconds(
    learner: tuple[str, Path],
) -> None:
    """Neither end of the connection hears anything; long before the ticket itself would expire."""
    address, _ = learner
    proxy = Proxy(int(address.rpartition(":")[2]))
    try:
        with Actor(proxy.address) as silent, Actor(address) as other, TrainingClient(address) as training:
            silent.ask()
            assert silent.order().episode_id == 0
            other.ask(4)
            assert [other.order().episode_id for _ in range(3)] == [1, 2, 3]
            begin = time.monotonic()
            assert proxy.stall(60.0)
            assert other.order().episode_id == 0
            assert time.monotonic() - begin < 15.0
            assert training.status().actors == 1
            # The actor's end notices as well.
            assert silent.error().code() == grpc.StatusCode.UNAVAILABLE
            assert time.monotonic() - begin < 15.0
    finally:
        proxy.close()


def nan_reward(message: rollout_pb2.Trajectory) -> None:
    message.reward.data = np.full(message.reward.shape[0], np.nan, np.float32).tobytes()


def never_ordered(message: rollout_pb2.Trajectory) -> None:
    message.episode_id = 999


def wrong_shape(message: rollout_pb2.Trajectory) -> None:
    message.obs.shape[1] += 1


def other_version(message: rollout_pb2.Trajectory) -> None:
    message.policy_version += 1


def no_action(message: rollout_pb2.Trajectory) -> None:
    message.mask.data = bytes(len(message.mask.data))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (nan_reward, "reward: wanted finite"),
        (never_ordered, "episode 999 was never ordered"),
        (wrong_shape, "obs: wanted float32"),
        (no_action, "no available action"),
        (other_version, "wanted policy version 0, got 1"),
    ],
)
def test_a_bad_trajectory_ends_its_stream_and_nothing_else(
    learner: tuple[str, Path], damage: Callable[[rollout_pb2.Trajectory], None], reason: str
) -> None:
    address, _ = learner
    with Actor(address) as actor:
        actor.ask()
        message = actor.play(actor.order())
        damage(message)
        actor.send(message)
        error = actor.error()
    assert error.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert reason in error.details()
    play_batches(address, 1)
    with TrainingClient(address) as training:
        service.wait_for(lambda: training.status().learner_step == 1, "the learner step")


@pytest.mark.parametrize(
    ("hello", "code"),
    [
        ({"env_spec_hash": "other"}, grpc.StatusCode.FAILED_PRECONDITION),
        ({"build": "other"}, grpc.StatusCode.FAILED_PRECONDITION),
    ],
)
def test_actors_that_would_play_other_episodes_are_refused(
    learner: tuple[str, Path], hello: dict[str, str], code: grpc.StatusCode
) -> None:
    with Actor(learner[0], **hello) as actor:
        error = actor.error()
    assert error.code() == code
    assert "wanted" in error.details()
    assert "got" in error.details()


def test_streams_that_break_the_protocol_are_refused(learner: tuple[str, Path]) -> None:
    with connect(learner[0]) as connection:
        stub = rollout_pb2_grpc.RolloutServiceStub(connection)
        ready = rollout_pb2.PlayRequest(ready=rollout_pb2.Ready(tickets=1))
        with pytest.raises(grpc.RpcError, match="must be hello"):
            next(stub.Play(iter([ready]), timeout=10))
    with Actor(learner[0]) as actor:
        actor.ask(0)
        assert actor.error().code() == grpc.StatusCode.INVALID_ARGUMENT


def test_messages_have_a_limit_that_is_not_the_librarys(learner: tuple[str, Path]) -> None:
    """gRPC's own is 4 MiB, and the largest map has episodes of 7; none at all would let memory go."""

    def refused(mebibytes: int) -> tuple[grpc.StatusCode, str]:
        hello = rollout_pb2.Hello(actor_id="a" * (mebibytes * 2**20))
        with pytest.raises(grpc.RpcError) as caught:
            next(stub.Play(iter([rollout_pb2.PlayRequest(hello=hello)]), timeout=60))
        return caught.value.code(), caught.value.details()

    # Not CHANNEL_OPTIONS, whose own limit would refuse first.
    with grpc.insecure_channel(learner[0], options=[("grpc.max_send_message_length", -1)]) as channel:
        stub = rollout_pb2_grpc.RolloutServiceStub(channel)
        code, reason = refused(8)
        assert code == grpc.StatusCode.INVALID_ARGUMENT
        assert "actor_id: wanted at most" in reason
        code, reason = refused(33)
        assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "larger than max" in reason


def test_checkpoints_are_listed_watched_and_fetched(learner: tuple[str, Path], tmp_path: Path) -> None:
    address, run_dir = learner
    play_batches(address, 3)
    with CheckpointClient(address) as client:
        watched = client.watch()
        first, second = next(watched), next(watched)
        assert [first.episode, second.episode] == [6, 12]
        assert list(client.list(after_episode=6)) == [second]
        manifest, tensors = client.get(6)
        stored = run_dir / "checkpoints" / "checkpoint-000000006.safetensors"
        assert manifest.sha256 == first.sha256 == sha256(stored.read_bytes()).hexdigest()
        assert manifest.policy_version == 2
        assert manifest.config["training"]["batch_episodes"] == 4
        shapes = {name: array.shape for name, array in checkpoint.section(tensors, "policy").items()}
        assert shapes == policy_shapes(make_player(PLAYER.env).spec, 64)
        stored.write_bytes(stored.read_bytes()[:-1])
        with pytest.raises(LiirError, match="corrupt"):
            client.get(6)
        with pytest.raises(LiirError, match="no checkpoint of episode 7"):
            client.get(7)


def evaluation_of(
    frozen: checkpoint_pb2.Checkpoint, wins: int = 0, return_mean: float = 0.0
) -> checkpoint_pb2.Evaluation:
    """The sampled episodes have one win less, where there is one, and half the return."""
    return checkpoint_pb2.Evaluation(
        episode=frozen.episode,
        sha256=frozen.sha256,
        env_steps=frozen.env_steps,
        greedy=stats_of(wins, return_mean),
        sampled=stats_of(max(0, wins - 1), return_mean / 2),
    )


def stats_of(wins: int, return_mean: float) -> checkpoint_pb2.EpisodeStats:
    means = {"won": wins / 4, "dead_allies": 1.0, "dead_enemies": 2.0}
    return checkpoint_pb2.EpisodeStats(episodes=4, wins=wins, return_mean=return_mean, info_means=means)


def test_evaluations_are_stored_once(learner: tuple[str, Path]) -> None:
    address, run_dir = learner
    play_batches(address, 2)
    with CheckpointClient(address) as client:
        frozen = next(client.watch())
        evaluation, partial, wrong = (evaluation_of(frozen, wins=3) for _ in range(3))
        del partial.greedy.info_means["won"]  # which would leave a cell of the table empty
        with pytest.raises(grpc.RpcError, match="greedy: wanted info of"):
            client.report(partial)
        assert client.report(evaluation)
        assert not client.report(evaluation)
        assert list(client.evaluations()) == [evaluation]
        rows = (run_dir / "evaluations.csv").read_text().splitlines()
        assert len(rows) == 2
        wrong.sha256 = "0"
        with pytest.raises(grpc.RpcError) as caught:
            client.report(wrong)
        assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT


# Not complete before twenty episodes of 60 steps at most, but soon after.
@pytest.mark.parametrize("learner", [("training.total_env_steps=1210",)], indirect=True)
def test_the_commands_list_watch_rank_and_fetch(learner: tuple[str, Path], tmp_path: Path) -> None:
    address, run_dir = learner

    def checkpoints(command: str, *rest: str) -> list[str]:
        arguments = ["checkpoints", command, "--learner", address, *rest]
        return CliRunner().invoke(app, arguments, catch_exceptions=False).stdout.splitlines()

    play_batches(address, 5)
    with CheckpointClient(address) as client:
        service.wait_for(lambda: len(list(client.list())) == 3, "three checkpoints")
        with pytest.raises(LiirError, match="no checkpoint has been tested yet"):
            checkpoints("best")
        for episode, wins, return_mean in ((6, 3, 9.0), (12, 3, 10.0), (18, 2, 20.0)):
            assert client.report(evaluation_of(client.find(episode), wins, return_mean))
        best = client.best()
        sha256_of = {frozen.episode: frozen.sha256 for frozen in client.list()}
    assert best.episode == 12
    assert_newest_test_is_shown(run_dir, greedy=(0.5, 20.0), sampled=(0.25, 10.0))
    assert find_checkpoint(None, run_dir, best=True).stem == "checkpoint-000000012"
    rows = [line.split() for line in checkpoints("list", "--map", "3m")]
    assert {int(row[0]): row[4] for row in rows} == sha256_of
    line, path = checkpoints("best", "--map", "3m", "-o", str(tmp_path / "best"))
    assert line.split()[0] == "12"
    assert line.endswith("won greedy 3/4, sampled 2/4; return 10.00")
    (fetched,) = checkpoints("get", "12", "-o", str(tmp_path / "got"))
    for file in (Path(path), Path(fetched)):
        assert sha256(file.read_bytes()).hexdigest() == sha256_of[12]
        Policy.load(file)
        assert len(list(file.parent.iterdir())) == 2, "the weights, the manifest, and nothing else"
    with pytest.raises(ConfigError, match=f"wanted a run on 8m; the learner at {address} trains on 3m"):
        checkpoints("list", "--map", "8m")
    with pytest.raises(LiirError, match="no checkpoint of episode 7"):
        checkpoints("get", "7", "-o", str(tmp_path))
    watching = service.start("checkpoints", "watch", "--map", "3m", "--after", "6", "--learner", address)
    assert watching.stdout
    watched = [watching.stdout.readline(), watching.stdout.readline()]  # while the run goes on
    complete(address, batches=5)
    _, *listed = checkpoints("list")
    report_the_rest(address)
    watched += watching.stdout
    assert [line.rstrip() for line in watched] == listed
    assert len(listed) > 2
    service.finish(watching)


def complete(address: str, batches: int) -> None:
    """Play a run of so many batches to its end; then the learner waits for the tests of its checkpoints."""
    with TrainingClient(address) as training:
        while True:
            service.wait_for(lambda wanted=batches: training.status().learner_step == wanted, "the last step")
            status = training.status()
            if status.env_steps >= status.total_env_steps:
                return
            play_batches(address, 1)
            batches += 1


def report_the_rest(address: str) -> None:
    """Hand in a test of every checkpoint that has none."""
    with CheckpointClient(address) as client:
        tested = {evaluation.episode for evaluation in client.evaluations()}
        for frozen in list(client.list()):
            if frozen.episode not in tested:
                assert client.report(evaluation_of(frozen))


def assert_newest_test_is_shown(run_dir: Path, **wanted: tuple[float, float]) -> None:
    """Win rate and mean return among the learner's metrics, by how the actions were chosen."""
    shown = service.samples(f"http://{service.endpoints(run_dir)['metrics']}/metrics")
    for actions, (win_rate, return_mean) in wanted.items():
        labels = f'{{actions="{actions}",map="3m"}}'
        assert shown[f"liir_win_rate{labels}"] == win_rate
        assert shown[f"liir_evaluation_return{labels}"] == return_mean


@needs_grpcurl
def test_grpcurl_needs_no_proto_files(learner: tuple[str, Path]) -> None:
    address, run_dir = learner
    play_batches(address, 2)

    def ask(method: str, **request: object) -> list[dict[str, Any]]:
        done = grpcurl("-plaintext", "-d", json.dumps(request), address, f"liir.v1.{method}")
        assert done.returncode == 0, done.stderr
        return [json.loads(text) for text in re.split(r"(?<=^})$", done.stdout, flags=re.M) if text.strip()]

    described = grpcurl("-plaintext", address, "describe").stdout
    assert "rpc GetCheckpoint" in described
    assert "rpc Stop" in described
    service.wait_for(lambda: bool(ask("CheckpointService/ListCheckpoints")[0]), "a checkpoint")
    (listed,) = ask("CheckpointService/ListCheckpoints")[0]["checkpoints"]
    assert listed["episode"] == "6"
    header, *chunks = ask("CheckpointService/GetCheckpoint", episode=6, offset=10)
    assert header["header"]["checkpoint"] == listed
    stored = (run_dir / "checkpoints" / "checkpoint-000000006.safetensors").read_bytes()
    assert b"".join(base64.b64decode(message["chunk"]) for message in chunks) == stored[10:]


@pytest.mark.parametrize("learner", [("checkpoints.keep_newest=1", "checkpoints.keep_best=0")], indirect=True)
def test_deleted_checkpoints_leave_gaps_that_say_so(learner: tuple[str, Path]) -> None:
    address, run_dir = learner
    play_batches(address, 5)
    with CheckpointClient(address) as client, TrainingClient(address) as training:
        watched = client.watch()
        frozen = [next(watched) for _ in range(3)]
        assert [checkpoint.episode for checkpoint in client.list()] == [6, 12, 18]
        for tested in frozen[:2]:
            assert client.report(evaluation_of(tested))
        assert list(client.list()) == [next(client.watch())] == frozen[2:]
        with pytest.raises(MissingError, match="checkpoint 6 was deleted"):
            client.get(6)
        # The answer to the first report may have been lost, so that it comes again.
        assert not client.report(evaluation_of(frozen[0]))
        assert client.report(evaluation_of(frozen[2]))
        assert list(client.list()) == frozen[2:]
        play_batches(address, 1)
        assert next(watched).episode == 24
        assert [checkpoint.episode for checkpoint in client.list()] == [24]
        status = training.status()
        assert (status.checkpoints, status.evaluations) == (4, 3)
    names = [path.name for path in (run_dir / "checkpoints").iterdir()]
    assert set(names) == {"checkpoint-000000024.json", "checkpoint-000000024.safetensors", "deleted.csv"}


def test_health_and_reflection(learner: tuple[str, Path]) -> None:
    with connect(learner[0]) as connection:
        health = health_pb2_grpc.HealthStub(connection)
        answer = health.Check(health_pb2.HealthCheckRequest(service="liir.v1.RolloutService"), timeout=10)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
        services = set(ProtoReflectionDescriptorDatabase(connection).get_services())
    names = ("RolloutService", "CheckpointService", "TrainingService")
    assert {f"liir.v1.{name}" for name in names} <= services
    assert "grpc.health.v1.Health" in services


@pytest.mark.parametrize(
    ("begin", "resume"), [([], ["--resume"]), (["--resume-if-begun"], ["--resume-if-begun"])]
)
def test_stop_saves_and_resume_goes_on(begin: list[str], resume: list[str], tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    options = ("--run-dir", str(run_dir), *service.arguments(["training.batch_episodes=4"]))
    process = service.start("learner", *begin, *options)
    service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
    address = service.endpoints(run_dir)["address"]
    play_batches(address, 2)
    with TrainingClient(address) as training:
        service.wait_for(lambda: training.status().learner_step == 2, "two learner steps")
        training.stop("test")
    service.finish(process)
    (run_dir / "endpoints.json").unlink()
    process = service.start("learner", *resume, *options)
    service.wait_for((run_dir / "endpoints.json").exists, "the learner's second start")
    with Actor(service.endpoints(run_dir)["address"]) as actor:
        actor.ask()
        ticket = actor.order()
    assert (ticket.episode_id, ticket.policy_version) == (8, 2)
    process.terminate()
    service.finish(process)


def test_a_learner_that_ends_lets_nobody_in_and_cuts_nobody_off(tmp_path: Path) -> None:
    """While an actor is still leaving, tickets stop and newcomers are refused; watchers hear the reason."""
    run_dir = tmp_path / "run"
    settings = ("training.batch_episodes=4", "training.checkpoint_interval=4")
    process = service.start("learner", "--run-dir", str(run_dir), *service.arguments(settings))
    service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
    address = service.endpoints(run_dir)["address"]
    play_batches(address, 1)
    # The learner waits a few seconds for an actor that leaves, and a player may take longer to make.
    player = make_player(PLAYER.env)
    with Actor(address) as slow, CheckpointClient(address) as client, TrainingClient(address) as training:
        slow.ask()
        slow.order()
        watched = client.watch()
        assert next(watched).episode == 4
        training.stop("test")
        response = slow.receive()
        assert response.HasField("drain")
        assert not response.drain.run_complete
        slow.ask()
        with Actor(address, player) as newcomer:
            newcomer.ask()
            error = newcomer.error()
        assert error.code() == grpc.StatusCode.UNAVAILABLE
        assert "come back" in str(error.details())
        assert training.status().actors == 1
        slow.leave()
        assert not [message for message in slow.rest() if message.tickets]
        with pytest.raises(grpc.RpcError) as caught:
            next(watched)
        assert caught.value.code() == grpc.StatusCode.UNAVAILABLE
        assert "when it is back" in str(caught.value.details())
    assert "Traceback" not in service.finish(process)


def test_a_learner_that_stays_serves_a_complete_run_and_takes_more_steps(tmp_path: Path) -> None:
    """Nobody is sent home for good: an actor and a watcher wait, and the run may be given more steps."""
    run_dir = tmp_path / "run"
    settings = ("training.batch_episodes=4", "training.checkpoint_interval=4", "learner.stay=true")

    def start(*more: str) -> tuple[subprocess.Popen[str], str]:
        options = ("--resume-if-begun", "--run-dir", str(run_dir), *service.arguments((*settings, *more)))
        process = service.start("learner", *options)
        service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
        return process, service.endpoints(run_dir)["address"]

    process, address = start("training.total_env_steps=1")
    play_batches(address, 1)
    with Actor(address) as actor, CheckpointClient(address) as client, TrainingClient(address) as training:
        watched = client.watch()
        client.report(evaluation_of(next(watched), wins=3))
        complete = training_pb2.PHASE_COMPLETE
        service.wait_for(lambda: training.status().phase == complete, "the complete run")
        assert client.get(4)
        actor.ask()
        training.stop("test")
        message = actor.receive()
        assert message.HasField("drain")
        assert not message.drain.run_complete
        actor.leave()
        with pytest.raises(grpc.RpcError) as caught:
            next(watched)
        assert caught.value.code() == grpc.StatusCode.UNAVAILABLE
    service.finish(process)
    (run_dir / "endpoints.json").unlink()
    process, address = start("training.total_env_steps=1000000")
    with Actor(address) as actor:
        actor.ask()
        assert actor.order().episode_id == 4
    process.terminate()
    service.finish(process)


def test_the_evaluator_tests_what_has_no_test_and_ends_with_the_run(tmp_path: Path) -> None:
    """The run's only batch freezes two checkpoints; the first is tested by somebody else."""
    run_dir = tmp_path / "run"
    settings = ("training.batch_episodes=4", "training.checkpoint_interval=2", "training.total_env_steps=1")
    process = service.start("learner", "--run-dir", str(run_dir), *service.arguments(settings))
    service.wait_for((run_dir / "endpoints.json").exists, "the learner's start")
    address = service.endpoints(run_dir)["address"]
    play_batches(address, 1)
    with CheckpointClient(address) as client:
        assert client.report(evaluation_of(next(client.watch()), wins=3))
    recorder = Recorder()
    Evaluator(address, learners_config(address, (), PLAINTEXT, Role.EVALUATOR), recorder).run()
    service.finish(process)
    others, own = read_table(run_dir / "evaluations.csv")
    assert (others["episode"], others["greedy_wins"], own["episode"]) == ("2", "3", "4")
    assert len(recorder.played) == 2 * PLAYER.evaluation.episodes
    assert own["greedy_length_mean"] != own["sampled_length_mean"], "else one may pass for the other"
    for mode, exploration in (("greedy", Exploration.GREEDY), ("sampled", Exploration.SOFTMAX_FLOOR)):
        lengths = [played.length for ticket, played in recorder.played if ticket.exploration == exploration]
        assert float(own[f"{mode}_length_mean"]) == np.mean(lengths)


def test_a_run_has_one_learner_at_a_time(learner: tuple[str, Path]) -> None:
    _, run_dir = learner
    before = (run_dir / "endpoints.json").read_bytes()
    second = service.start("learner", "--resume", "--run-dir", str(run_dir), "--set", "learner.port=0")
    assert "another process works in" in service.finish(second, code=2)
    assert (run_dir / "endpoints.json").read_bytes() == before


def test_a_busy_port_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for key, advice in (
            ("learner.port", "learner.port=N"),
            ("learner.metrics_port", "learner.metrics_port=N"),
        ):
            settings = service.arguments([f"{key}={port}"])
            process = service.start("learner", "--run-dir", str(tmp_path / key), *settings)
            assert advice in service.finish(process, code=2)


def test_an_evaluators_busy_metrics_port_is_an_error_that_names_its_key(learner: tuple[str, Path]) -> None:
    address, _ = learner
    with socket.create_server(("127.0.0.1", 0)) as taken:
        setting = f"evaluation.metrics_port={taken.getsockname()[1]}"
        process = service.start("evaluator", "--learner", address, "--set", setting)
        assert "--set evaluation.metrics_port=N" in service.finish(process, code=2)


def test_an_open_address_is_refused_unless_asked_for(tmp_path: Path) -> None:
    process = service.start(
        "learner", "--run-dir", str(tmp_path / "run"), *service.arguments(["learner.host=0.0.0.0"])
    )
    assert "learner.insecure=true" in service.finish(process, code=2)


def test_the_health_command_says_whether_a_learner_serves(learner: tuple[str, Path]) -> None:
    service.finish(service.start("health", "--learner", learner[0]))
    silent = service.start("health", "--learner", f"127.0.0.1:{service.free_port()}")
    assert "no learner answered" in service.finish(silent, code=3)


def test_an_unreachable_learner_is_an_error_that_says_so() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(UnreachableError, match="no learner answered"):
            connect(address, timeout_s=0.5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["env.map=4m"], "4m"),
        (["env.options.reward_only_positiv=true"], "reward_only_positiv"),
        (["trainig.lag=1"], "did you mean 'training'"),
    ],
)
def test_a_bad_configuration_ends_every_command_with_code_two(
    tmp_path: Path, settings: list[str], message: str
) -> None:
    for command in ("learner", "train"):
        process = service.start(command, "--run-dir", str(tmp_path / command), *service.arguments(settings))
        assert message in service.finish(process, code=2)
