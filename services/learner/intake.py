"""Which episodes are to be played, by whom, and which have come back: the ledger behind the tickets.

No clock, no network and no thread: a state machine that one event loop drives. Tickets given out and
not yet played are the actors' credits, so the memory behind them is bounded by the open batches.
"""

from __future__ import annotations

import math
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
        """Per actor, when each of its tickets was given; infinity once another has it too."""
        self._credits: dict[Actor, int] = {}
        """Per actor, how many tickets more it can hold."""
        self._asking: deque[Actor] = deque()
        """Actors with credits, each once, the longest wait first."""
        self._played: dict[int, Trajectory] = {}

    @property
    def outstanding(self) -> int:
        """Tickets given out and not yet played."""
        return len(self._unplayed.keys() & {e for held in self._held.values() for e in held})

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
        self._credits[actor] = 0

    def ask(self, actor: Actor, tickets: int) -> None:
        """The actor can hold that many tickets more."""
        if not self._credits[actor]:
            self._asking.append(actor)
        self._credits[actor] += tickets

    def assign(self, now: float) -> Iterator[tuple[Actor, Ticket]]:
        """Match tickets with actors, oldest episode and longest wait first.

        An actor gets all that it can hold before the next gets any, since each needs the policy; one whose
        episodes take long asks for one ticket at a time. Who is late with a ticket has it still.
        """
        while self._asking and (ticket := self._next_ticket()):
            episode = ticket.episode_id
            actor = next((actor for actor in self._asking if episode not in self._held[actor]), None)
            if actor is None:
                self._held[self._asking[0]][episode] = now  # and is late again after as long
                continue
            self._credits[actor] -= 1
            if not self._credits[actor]:
                self._asking.remove(actor)
            self._held[actor][episode] = now
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
        ticket = self._unplayed.get(episode)
        if ticket is not None and trajectory.policy_version != ticket.policy_version:
            # The actor keeps its ticket, so that leaving gives it to another.
            raise ValueError(
                f"episode {episode}: wanted policy version {ticket.policy_version}, "
                f"got {trajectory.policy_version}"
            )
        if self._held[actor].pop(episode, None) is not None:
            self.ask(actor, 1)
        if ticket is None:
            return False
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

    def held(self, actor: Actor) -> int:
        """How many tickets it has not answered, those that others have by now among them."""
        return len(self._held[actor])

    def leave(self, actor: Actor) -> int:
        """The actor is gone; its unplayed tickets go to others. Returns how many."""
        if self._credits.pop(actor):
            self._asking.remove(actor)
        return self._give_again([e for e, given in self._held.pop(actor).items() if given < math.inf])

    def expire(self, given_before: float) -> int:
        """Give tickets that were given out before that time to others as well. Returns how many."""
        late = []
        for held in self._held.values():
            for episode, given in held.items():
                if given < given_before:
                    held[episode] = math.inf
                    late.append(episode)
        return self._give_again(late)

    def _give_again(self, episodes: list[int]) -> int:
        unplayed = sorted(episode for episode in episodes if episode in self._unplayed)
        self._to_give.extendleft(reversed(unplayed))
        return len(unplayed)
