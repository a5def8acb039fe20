"""Which episodes are to be played, by whom, and which have come back: the ledger behind the tickets.

No clock, no network and no thread: a state machine that one event loop drives. Tickets given out and
not yet played are the actors' credits, so the memory behind them is bounded by the open batches.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

from liir_common.types import Exploration, Ticket, Trajectory

Actor = Hashable


@dataclass(frozen=True)
class Opening:
    """A batch that may be played now: which one, by which policy."""

    batch: int
    policy_version: int
    epsilon: float


class Intake:
    """Gives out tickets of open batches, takes each episode once, delivers batches whole and in order."""

    def __init__(
        self,
        run_seed: int,
        exploration: Exploration,
        batch_episodes: int,
        first_batch: int,
        deliver: Callable[[list[Trajectory]], None],
    ) -> None:
        """Start before `first_batch`; `deliver` gets each complete batch in episode order."""
        self._run_seed = run_seed
        self._exploration = exploration
        self._batch_episodes = batch_episodes
        self._deliver = deliver
        self._delivered = first_batch * batch_episodes
        """Episodes below this one have been delivered."""
        self._opened = self._delivered
        """Episodes below this one have had tickets."""
        self._unplayed: dict[int, Ticket] = {}
        self._to_give: deque[int] = deque()
        self._held: dict[Actor, dict[int, float]] = {}
        """Per actor, when each of its tickets was given."""
        self._asking: deque[Actor] = deque()
        self._played: dict[int, Trajectory] = {}

    @property
    def outstanding(self) -> int:
        """Tickets given out and not yet played."""
        return len({episode for held in self._held.values() for episode in held})

    def open(self, opening: Opening) -> None:
        """Make the next batch's tickets available."""
        first = opening.batch * self._batch_episodes
        if first != self._opened:
            raise ValueError(f"wanted the batch that starts at episode {self._opened}, got {first}")
        for episode in range(first, first + self._batch_episodes):
            self._unplayed[episode] = Ticket.for_training(
                self._run_seed, episode, opening.policy_version, self._exploration, opening.epsilon
            )
            self._to_give.append(episode)
        self._opened = first + self._batch_episodes

    def join(self, actor: Actor) -> None:
        """An actor is here."""
        self._held[actor] = {}

    def ask(self, actor: Actor, tickets: int) -> None:
        """The actor wants that many tickets more."""
        self._asking.extend([actor] * tickets)

    def assign(self, now: float) -> Iterator[tuple[Actor, Ticket]]:
        """Match tickets with actors, oldest episode and longest wait first."""
        while self._to_give and self._asking:
            actor = self._asking.popleft()
            if actor not in self._held:
                continue
            ticket = self._next_ticket()
            if ticket is None:
                self._asking.appendleft(actor)
                return
            self._held[actor][ticket.episode_id] = now
            yield actor, ticket

    def _next_ticket(self) -> Ticket | None:
        while self._to_give:
            ticket = self._unplayed.get(self._to_give.popleft())
            if ticket is not None:  # else its first holder played it after all
                return ticket
        return None

    def accept(self, actor: Actor, trajectory: Trajectory) -> bool:
        """Take an episode; false if it had come before, which changes nothing.

        Raises:
            ValueError: nobody ordered that episode, or with that policy version.
        """
        episode = trajectory.episode_id
        if episode >= self._opened:
            raise ValueError(f"episode {episode} was never ordered; the last ticket was {self._opened - 1}")
        self._held[actor].pop(episode, None)
        ticket = self._unplayed.get(episode)
        if ticket is None:
            return False
        if trajectory.policy_version != ticket.policy_version:
            raise ValueError(
                f"episode {episode}: wanted policy version {ticket.policy_version}, "
                f"got {trajectory.policy_version}"
            )
        del self._unplayed[episode]
        self._played[episode] = trajectory
        self._deliver_complete()
        return True

    def _deliver_complete(self) -> None:
        while True:
            episodes = range(self._delivered, self._delivered + self._batch_episodes)
            if not all(episode in self._played for episode in episodes):
                return
            self._delivered = episodes.stop
            self._deliver([self._played.pop(episode) for episode in episodes])

    def leave(self, actor: Actor) -> int:
        """The actor is gone; its unplayed tickets go to others. Returns how many."""
        return self._give_again(self._held.pop(actor, {}))

    def expire(self, given_before: float) -> int:
        """Give tickets that were given out before that time to others as well. Returns how many."""
        late = {
            episode: given
            for held in self._held.values()
            for episode, given in held.items()
            if given < given_before
        }
        for held in self._held.values():
            for episode in late:
                held.pop(episode, None)
        return self._give_again(late)

    def _give_again(self, episodes: dict[int, float]) -> int:
        held_elsewhere = {episode for held in self._held.values() for episode in held}
        lost = sorted(e for e in episodes if e in self._unplayed and e not in held_elsewhere)
        self._to_give.extendleft(reversed(lost))
        return len(lost)
