"""The ticket ledger: every episode once, batches in order, whoever comes, leaves or is late."""

import random

import pytest

from liir_common import seeds
from liir_common.types import Exploration, Ticket, Trajectory
from services.learner.intake import Intake, Opening
from tests.samples import make_trajectory

BATCH = 4


def make_intake(first_batch: int = 0) -> tuple[Intake, list[list[int]]]:
    delivered: list[list[int]] = []

    def deliver(batch: list[Trajectory]) -> None:
        delivered.append([trajectory.episode_id for trajectory in batch])

    return Intake(7, Exploration.SOFTMAX_FLOOR, BATCH, first_batch, deliver), delivered


def give(intake: Intake, now: float = 0.0) -> list[tuple[object, Ticket]]:
    return list(intake.assign(now))


def test_each_actor_gets_one_ticket_per_request_oldest_first() -> None:
    intake, _ = make_intake()
    for actor in "ab":
        intake.join(actor)
        intake.ask(actor, 1)
    assert give(intake) == []
    intake.open(Opening(0, 0, 0.25))
    given = give(intake)
    assert [(actor, ticket.episode_id) for actor, ticket in given] == [("a", 0), ("b", 1)]
    ticket = given[0][1]
    assert ticket.seed == seeds.episode_seed(7, seeds.TRAINING, 0)
    assert (ticket.policy_version, ticket.epsilon) == (0, 0.25)
    assert intake.outstanding == 2


def test_an_actor_gets_all_that_it_can_hold_before_the_next_gets_any() -> None:
    intake, _ = make_intake()
    intake.open(Opening(0, 0, 0.0))
    for actor in "abc":
        intake.join(actor)
        intake.ask(actor, 2)
    assert [actor for actor, _ in give(intake)] == ["a", "a", "b", "b"]


def test_a_trajectory_makes_room_for_the_next_ticket_once() -> None:
    intake, _ = make_intake()
    intake.join("a")
    intake.open(Opening(0, 0, 0.0))
    intake.ask("a", 1)
    assert [ticket.episode_id for _, ticket in give(intake)] == [0]
    assert give(intake) == []
    for _ in range(2):
        intake.accept("a", make_trajectory(0))
    assert [ticket.episode_id for _, ticket in give(intake)] == [1]


def test_batches_come_whole_and_in_order_whatever_the_arrival_order() -> None:
    intake, delivered = make_intake()
    intake.join("a")
    intake.open(Opening(0, 0, 0.0))
    intake.open(Opening(1, 0, 0.0))
    intake.ask("a", 2 * BATCH)
    episodes = [ticket.episode_id for _, ticket in give(intake)]
    random.Random(1).shuffle(episodes)
    for episode in sorted(episodes, key=lambda e: e < BATCH):  # the second batch is complete first
        assert intake.accept("a", make_trajectory(episode))
    assert delivered == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_a_second_copy_changes_nothing() -> None:
    intake, delivered = make_intake()
    intake.join("a")
    intake.open(Opening(0, 0, 0.0))
    intake.ask("a", BATCH)
    give(intake)
    assert intake.accept("a", make_trajectory(0))
    assert not intake.accept("a", make_trajectory(0))
    for episode in (1, 2, 3):
        intake.accept("a", make_trajectory(episode))
    assert not intake.accept("a", make_trajectory(2))
    assert delivered == [[0, 1, 2, 3]]


def test_tickets_of_an_actor_that_left_go_to_another_first() -> None:
    intake, _ = make_intake()
    for actor in "ab":
        intake.join(actor)
    intake.open(Opening(0, 0, 0.0))
    intake.ask("a", 2)
    give(intake)
    assert intake.leave("a") == 2
    intake.ask("b", BATCH)
    assert [ticket.episode_id for _, ticket in give(intake)] == [0, 1, 2, 3]


def test_a_refused_episode_is_played_by_another() -> None:
    intake, _ = make_intake()
    for actor in "ab":
        intake.join(actor)
    intake.open(Opening(0, 0, 0.0))
    intake.ask("a", 1)
    give(intake)
    with pytest.raises(ValueError, match="wanted policy version 0, got 1"):
        intake.accept("a", make_trajectory(0, version=1))
    assert intake.leave("a") == 1
    intake.ask("b", 1)
    assert [ticket.episode_id for _, ticket in give(intake)] == [0]


def test_requests_of_an_actor_that_left_are_forgotten() -> None:
    intake, _ = make_intake()
    for actor in "ab":
        intake.join(actor)
        intake.ask(actor, 1)
    intake.leave("a")
    intake.open(Opening(0, 0, 0.0))
    assert [actor for actor, _ in give(intake)] == ["b"]


def test_late_tickets_are_given_to_others_and_taken_from_whoever_is_first() -> None:
    intake, _ = make_intake()
    for actor in "ab":
        intake.join(actor)
    intake.open(Opening(0, 0, 0.0))
    intake.ask("a", 1)
    give(intake, now=1.0)
    assert intake.expire(given_before=1.0) == 0
    assert intake.expire(given_before=2.0) == 1
    intake.ask("b", 1)
    assert [ticket.episode_id for _, ticket in give(intake, now=3.0)] == [0]
    assert intake.accept("a", make_trajectory(0))
    assert not intake.accept("b", make_trajectory(0))


def test_a_late_ticket_played_after_all_is_not_given_again() -> None:
    intake, _ = make_intake()
    intake.join("a")
    intake.open(Opening(0, 0, 0.0))
    intake.ask("a", 1)
    give(intake, now=0.0)
    intake.expire(given_before=1.0)
    intake.accept("a", make_trajectory(0))
    intake.ask("a", BATCH - 2)
    assert [ticket.episode_id for _, ticket in give(intake)] == [1, 2, 3]


def test_a_late_ticket_passes_by_the_actor_that_has_it_and_could_hold_more() -> None:
    """An actor that hangs must not keep from others what it is late with by asking first."""
    intake, delivered = make_intake()
    for actor in "ab":
        intake.join(actor)
        intake.ask(actor, 3)
    intake.open(Opening(0, 0, 0.0))
    assert [actor for actor, _ in give(intake)] == ["a", "a", "a", "b"]
    for episode in range(3):
        intake.accept("a", make_trajectory(episode))
    assert intake.expire(given_before=1.0) == 1
    assert [(actor, ticket.episode_id) for actor, ticket in give(intake, 2.0)] == [("a", 3)]
    intake.accept("a", make_trajectory(3))
    assert delivered == [[0, 1, 2, 3]]


def test_a_late_ticket_stays_with_an_actor_that_asks_again_and_costs_it_nothing() -> None:
    intake, _ = make_intake()
    intake.join("a")
    intake.open(Opening(0, 0, 0.0))
    intake.ask("a", 2)
    give(intake, now=0.0)
    assert intake.expire(given_before=1.0) == 2
    intake.accept("a", make_trajectory(0))
    # Episode 1 is with it already; the room that episode 0 left is for another.
    assert [ticket.episode_id for _, ticket in give(intake, now=2.0)] == [2]
    assert intake.expire(given_before=2.0) == 0, "it has been given out at 2"
    intake.accept("a", make_trajectory(1))
    assert [ticket.episode_id for _, ticket in give(intake)] == [3]


def test_what_was_never_ordered_is_refused() -> None:
    intake, _ = make_intake(first_batch=2)
    intake.join("a")
    intake.open(Opening(2, 5, 0.0))
    with pytest.raises(ValueError, match="never ordered"):
        intake.accept("a", make_trajectory(3 * BATCH))
    with pytest.raises(ValueError, match="wanted policy version 5, got 4"):
        intake.accept("a", make_trajectory(2 * BATCH, version=4))
    with pytest.raises(ValueError, match="wanted the batch that starts at episode 12"):
        intake.open(Opening(2, 5, 0.0))
    assert not intake.accept("a", make_trajectory(0))  # of before the resume: consumed long ago


@pytest.mark.parametrize("seed", range(20))
def test_any_history_delivers_every_episode_once_in_order(seed: int) -> None:
    """Random joins, deaths, time-outs, duplicates: the batches stay the same."""
    dice = random.Random(seed)
    intake, delivered = make_intake()
    actors: dict[str, list[Ticket]] = {}
    batches, clock, joined = 6, 0.0, 0
    for batch in range(batches):
        intake.open(Opening(batch, 0, 0.0))
    while len(delivered) < batches:
        clock += 1.0
        event = dice.random()
        if event < 0.1 or not actors:
            joined += 1
            actors[f"actor-{joined}"] = []
            intake.join(f"actor-{joined}")
            intake.ask(f"actor-{joined}", dice.randint(1, 3))
        elif event < 0.2:
            gone = dice.choice(sorted(actors))
            del actors[gone]
            intake.leave(gone)
        elif event < 0.3:
            intake.expire(clock - 5.0)
        else:
            actor = dice.choice(sorted(actors))
            if actors[actor]:
                ticket = dice.choice(actors[actor])  # kept: it may come again
                intake.accept(actor, make_trajectory(ticket.episode_id))
        for holder, ticket in intake.assign(clock):
            actors[str(holder)].append(ticket)
    assert delivered == [list(range(b * BATCH, (b + 1) * BATCH)) for b in range(batches)]
    assert intake.outstanding == 0
