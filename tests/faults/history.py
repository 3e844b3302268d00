"""What clients asked for and were answered, and what must be true of it. Pure."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

from faults.linearizability import Operation, is_linearizable, unexplained

DELIVERY_S = 0.5
"""How long a message of a term may be on its way when the next term has begun."""


class Fate(Enum):
    """What a client knows of a request."""

    DONE = "done"
    NOT_DONE = "not done"
    """The master said that nothing was done."""
    MISSING = "missing"
    """The master said that what was to be removed does not exist."""
    UNKNOWN = "unknown"


class Expected(Enum):
    """What must be true of a container by the answers of the masters."""

    RUNS = "runs"
    GONE = "gone"
    EITHER = "either"
    """A request about it was not answered."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A master's message to a task set, in seconds since the start of the machine.

    Attributes:
        after: It was sent after this time: that of the newest request that was answered on its connection.
    """

    at: float
    master: str
    term: int
    message: str
    after: float = -math.inf


@dataclass
class History:
    """All that clients and task sets saw.

    Attributes:
        made: The fate of each request that makes a robot's token, by the robot.
        containers: What is expected of each container.
        registers: Reads and writes of each register.
        heard: What masters told task sets, in the order in which it came.
        acknowledged: Start and end of each write that was acknowledged.
        lost_links: What robots saw of links that were interrupted.
        lost_containers: Containers that ran by the answers of the masters, and were not found when they were
            to be removed.
        doubled_containers: Containers that ran twice for a while.
        cuts: Masters whose packets to clients were held up, with start and end. TCP sends again what was on
            its way then, and it arrives when the network is back; task sets refuse it by its term.
        stops: Masters that were stopped, and when they went on. One that is stopped between its look at the
            lease and the write sends that one message when it goes on; task sets refuse it by its term.
    """

    made: dict[str, Fate] = field(default_factory=dict)
    containers: dict[str, Expected] = field(default_factory=dict)
    registers: dict[str, list[Operation]] = field(default_factory=dict)
    heard: list[Heard] = field(default_factory=list)
    acknowledged: list[tuple[float, float]] = field(default_factory=list)
    lost_links: list[str] = field(default_factory=list)
    lost_containers: list[str] = field(default_factory=list)
    doubled_containers: set[str] = field(default_factory=set)
    cuts: list[tuple[str, float, float]] = field(default_factory=list)
    stops: list[tuple[str, float]] = field(default_factory=list)
    _seen_twice: set[str] = field(default_factory=set)
    """What ran twice at the last look."""

    def wrote(self, register: str, start: float, end: float, value: int, fate: Fate) -> None:
        """Note a write."""
        if fate is not Fate.NOT_DONE:
            known = end if fate is Fate.DONE else math.inf
            self.registers.setdefault(register, []).append(Operation(start, known, True, value))
        if fate is Fate.DONE:
            self.acknowledged.append((start, end))

    def read(self, register: str, start: float, end: float, value: int) -> None:
        """Note a read."""
        self.registers.setdefault(register, []).append(Operation(start, end, False, value))

    def read_since(self, at: float) -> set[str]:
        """Return the registers of which a read was answered that was asked for after a time."""
        return {
            name
            for name, operations in self.registers.items()
            if any(not each.is_write and each.start >= at for each in operations)
        }

    @property
    def reads(self) -> int:
        """How many reads of registers were answered."""
        return sum(not each.is_write for operations in self.registers.values() for each in operations)

    def changed_container(self, name: str, before: Expected, fate: Fate, *, made: bool) -> None:
        """Note the answer to a request that makes or removes a container.

        Args:
            name: The container.
            before: What was expected of it before the request.
            fate: What the answer says of the request.
            made: Whether it was to be made.
        """
        match fate:
            case Fate.DONE:
                self.containers[name] = Expected.RUNS if made else Expected.GONE
            case Fate.NOT_DONE:
                self.containers[name] = before
            case Fate.MISSING:
                if before is Expected.RUNS:
                    self.lost_containers.append(name)
                self.containers[name] = Expected.GONE
            case Fate.UNKNOWN:
                self.containers[name] = Expected.EITHER

    def saw_running(self, running: Iterable[str]) -> None:
        """Note a look at the containers. A process that was just forked may look like its parent in one look.

        Args:
            running: The containers that run, once for each.
        """
        twice = {name for name, times in Counter(running).items() if times > 1}
        self.doubled_containers |= twice & self._seen_twice
        self._seen_twice = twice

    def misplaced(self, running: Iterable[str]) -> list[str]:
        """Return what a task set does that was not asked for, or does not do that was.

        Args:
            running: The containers that it runs, once for each.
        """
        count = Counter(running)
        return [
            *(
                f"container {name} was acknowledged and does not run"
                for name, expected in self.containers.items()
                if expected is Expected.RUNS and not count[name]
            ),
            *(
                f"container {name} was removed, or refused, and runs"
                for name, expected in self.containers.items()
                if expected is Expected.GONE and count[name]
            ),
            *(f"container {name} runs {times} times" for name, times in count.items() if times > 1),
            *(
                f"container {name} runs and was not asked for"
                for name in count
                if name not in self.containers
            ),
        ]

    def first_write_after(self, at: float) -> float | None:
        """Return when the first write was acknowledged that was asked for after a time."""
        return min((end for start, end in self.acknowledged if start >= at), default=None)

    def longest_pause(self, start: float, end: float) -> float:
        """Return the longest time without an acknowledged write between two moments, seconds."""
        within = sorted(at for _, at in self.acknowledged if start < at < end)
        return max(after - before for before, after in itertools.pairwise([start, *within, end]))

    def violations(self, stored: Iterable[str], initial: int) -> list[str]:
        """Return what went wrong; nothing may.

        Args:
            stored: The robots of the tokens that the masters know at the end, once for each token.
            initial: What registers held at the start.
        """
        return [
            *self.lost(Counter(stored)),
            *self.not_linearizable(initial),
            *self.of_older_terms(),
            *self.lost_links,
            *self.wrong_containers(),
        ]

    def not_linearizable(self, initial: int) -> Iterable[str]:
        """Yield the registers whose reads and writes no order explains.

        Args:
            initial: What registers held at the start.
        """
        for name, operations in self.registers.items():
            if not is_linearizable(operations, initial):
                yield f"{name} is not linearizable: {' '.join(map(str, unexplained(operations, initial)))}"

    def wrong_containers(self) -> Iterable[str]:
        """Yield which containers were lost or ran twice while clients changed them."""
        for name in self.lost_containers:
            yield f"container {name} was acknowledged, and was not found when it was to be removed"
        for name in sorted(self.doubled_containers):
            yield f"container {name} ran twice for a while"

    def lost(self, stored: Counter[str]) -> Iterable[str]:
        """Yield what was acknowledged and is lost, refused and done, or done twice."""
        for robot, fate in self.made.items():
            if fate is Fate.DONE and not stored[robot]:
                yield f"{robot} was acknowledged and is lost"
            if fate is Fate.NOT_DONE and stored[robot]:
                yield f"{robot} was refused and was done"
            if stored[robot] > 1:
                yield f"{robot} was done {stored[robot]} times"

    def _is_late(self, heard: Heard) -> bool:
        """Return whether a message may have been sent before its master's packets were held up, or meanwhile.

        Pauses between two attempts of TCP double: the next one comes after at most the time that has passed.
        """
        return any(
            heard.master == master and start <= heard.at <= end + (end - start) + DELIVERY_S
            for master, start, end in self.cuts
        )

    def of_older_terms(self) -> Iterable[str]:
        """Yield what was heard of masters that led no more, and of two that led at once.

        What was on its way when a newer term began may come late. An answer to a request that was made after
        that, and all that follows it on its connection, was not on its way.
        """
        begun: dict[int, float] = {}
        leaders: dict[int, str] = {}
        for each in self.heard:
            begun.setdefault(each.term, each.at)
            if leaders.setdefault(each.term, each.master) != each.master:
                yield f"{leaders[each.term]} and {each.master} both led in term {each.term}"
        begun_to_send = list(self.stops)
        for each in self.heard:
            newer = min((at for term, at in begun.items() if term > each.term), default=math.inf)
            is_held_up = each.at <= newer + DELIVERY_S or self._is_late(each)
            if each.after <= newer and is_held_up:
                continue
            stop = next((stop for stop in begun_to_send if _ended(stop, each)), None)
            if stop is not None:
                begun_to_send.remove(stop)
            else:
                yield f"{each} came {each.at - newer:.1f} s after a newer term had begun"


def _ended(stop: tuple[str, float], heard: Heard) -> bool:
    """Return whether a message came from a master that had just gone on."""
    master, end = stop
    return heard.master == master and end <= heard.at <= end + DELIVERY_S
