"""Life cycles as data: states, the events of each, and the state that follows. Pure.

A life cycle is a literal table. As the table is the only definition of its transitions, tests, diagrams and
``match`` statements can be made or checked from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import Generic, TypeAlias, TypeVar

S = TypeVar("S", bound=Enum)
E = TypeVar("E", bound=Enum)

REMEMBERED = 8
"""How many of the last events are remembered, for the error that an impossible one raises."""

Table: TypeAlias = Mapping[S, Mapping[E, S]]
"""State to event to the state that follows."""


class InvalidTransitionError(Exception):
    """An event came that its life cycle does not allow in the present state. Nothing was changed.

    Attributes:
        subject: The object of the event, for example ``container alice/c1``.
        state: The present state.
        event: The event.
        possible: The events that are allowed in that state.
        recent: The events before, the newest last.
    """

    def __init__(
        self, subject: str, state: Enum, event: Enum, possible: tuple[Enum, ...], recent: tuple[Enum, ...]
    ) -> None:
        super().__init__(subject, state, event, possible, recent)
        self.subject = subject
        self.state = state
        self.event = event
        self.possible = possible
        self.recent = recent

    def __str__(self) -> str:
        return (
            f"{self.subject} is {_text(self.state)}: expected {_listed(self.possible, ' or ')},"
            f" found {_text(self.event)}; the events before were {_listed(self.recent)}"
        )


class LifeCycle(Generic[S, E]):
    """A life cycle: its table and its transitions.

    Args:
        subject: The kind of object, for errors and diagrams: ``container``, ``node``.
        table: A row for every state; one without events is an end.
        error: What :meth:`advance` raises.

    Raises:
        ValueError: A state that the table leads to has no row.

    Example:
        >>> TABLE = {Door.OPEN: {Push.SHUT: Door.CLOSED}, Door.CLOSED: {Push.OPEN: Door.OPEN}}
        >>> DOOR = LifeCycle("door", TABLE)
        >>> DOOR.advance(Door.OPEN, Push.SHUT)
        <Door.CLOSED: 'closed'>
    """

    def __init__(
        self,
        subject: str,
        table: Table[S, E],
        *,
        error: type[InvalidTransitionError] = InvalidTransitionError,
    ) -> None:
        self.subject = subject
        self.table: Table[S, E] = MappingProxyType(
            {state: MappingProxyType(dict(row)) for state, row in table.items()}
        )
        self._error = error
        if lost := {after for row in table.values() for after in row.values()} - table.keys():
            raise ValueError(f"the life cycle of a {subject} has no row for {_listed(tuple(lost))}")

    def allows(self, state: S, event: E) -> bool:
        """Return whether an event can happen in a state."""
        return event in self.table[state]

    def advance(self, state: S, event: E, name: str = "", recent: tuple[E, ...] = ()) -> S:
        """Return the state that follows.

        Args:
            state: The present state.
            event: The event.
            name: The object's name, for the error.
            recent: The events before, for the error.

        Raises:
            InvalidTransitionError: The event cannot happen in that state. (Or the cycle's own error.)
        """
        row = self.table[state]
        after = row.get(event)
        if after is None:
            subject = f"{self.subject} {name}" if name else self.subject
            raise self._error(subject, state, event, tuple(row), recent)
        return after

    def start(self, state: S, name: str = "") -> StateMachine[S, E]:
        """Return a state machine of this life cycle, which begins in ``state``."""
        return StateMachine(self, state, name)


class StateMachine(Generic[S, E]):
    """The state of an object in its life cycle. The state changes only by :meth:`advance`.

    Attributes:
        name: The object's name, for the error.
        recent: Its last events, the newest last; one that came several times in a row is there once.
    """

    __slots__ = ("_cycle", "_state", "name", "recent")

    def __init__(self, cycle: LifeCycle[S, E], state: S, name: str) -> None:
        self._cycle = cycle
        self._state = state
        self.name = name
        self.recent: tuple[E, ...] = ()

    def __repr__(self) -> str:
        return f"<{self._cycle.subject} {self.name}: {_text(self._state)}>"

    @property
    def state(self) -> S:
        """The present state."""
        return self._state

    def allows(self, event: E) -> bool:
        """Return whether an event can happen now."""
        return self._cycle.allows(self._state, event)

    def advance(self, event: E) -> S:
        """Apply an event; return the state that follows.

        Raises:
            InvalidTransitionError: It cannot happen now. Nothing was changed. (Or the cycle's own error.)
        """
        self._state = self._cycle.advance(self._state, event, self.name, self.recent)
        self.recent = remember(self.recent, event)
        return self._state


def remember(recent: tuple[E, ...], event: E) -> tuple[E, ...]:
    """Return the last events with a new one, repetitions as one; for records that are values."""
    return recent if recent[-1:] == (event,) else (*recent, event)[-REMEMBERED:]


def _text(one: Enum) -> str:
    return one.value if isinstance(one.value, str) else one.name


def _listed(some: tuple[Enum, ...], joint: str = ", ") -> str:
    return joint.join(map(_text, some)) or "none"
