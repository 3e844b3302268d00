"""Advice for users: which containers are too small or too large, which machines too full. Pure.

Every piece names the observation and the command that fixes the problem.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from msgspec.structs import replace

from rce.model import MEGABYTE, MIN_MEMORY, Resources, write_cores, write_memory
from rce_master.usage import STEP_S, WINDOW_S, History, rates_between

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rce_master.state.placement import Room

THROTTLED = 0.1
"""A container that is held back by its CPU limit for more than this share of the time is too small."""
NEARLY_FULL = 0.9
"""Share of memory: a container that uses more is too small; a machine that has promised more is too full."""
HARDLY_USED = 0.25
"""A container that never used this share of its request is too large."""
OBSERVED_S = 300.0
"""Seconds of observation before a container can count as too large."""
_SOON_S = 20.0
_MEMORY_STEP = 16 * MEGABYTE
_CORES_STEP = 0.05


class Advice(NamedTuple):
    """One piece of advice."""

    about: str
    """``too small``, ``too large`` or ``too full``."""
    text: str
    command: str


class Subject(NamedTuple):
    """The container that advice is about."""

    tag: str
    requested: Resources
    user: str = ""
    """Whose it is, for the commands; empty: the reader's, who need not name that."""

    def command(self, verb: str, arguments: str) -> str:
        """Return a command about it."""
        whose = f" --user {self.user}" if self.user else ""
        return f"rce {verb} {self.tag} {arguments}{whose}"


def for_container(
    subject: Subject, history: History, room: Room | None, others: Sequence[Room] = ()
) -> list[Advice]:
    """Return advice on whether a container should be resized or moved.

    Args:
        subject: The container.
        history: Its usage.
        room: Its machine, to find out whether it has room to grow; None if unknown.
        others: Machines that it could move to, the emptiest first; its own may be among them.
    """
    return [*_too_small(subject, history, _Rooms(room, others)), *_too_large(subject, history)]


class _Rooms(NamedTuple):
    """A container's machine, and others."""

    own: Room | None
    others: Sequence[Room]


def _too_small(subject: Subject, history: History, rooms: _Rooms) -> Iterator[Advice]:
    now, samples = history.now.usage, history.samples
    oldest = samples[0]
    watched = history.now.time - oldest.time
    kills = now.oom_kills - (oldest.usage.oom_kills if watched >= WINDOW_S - 2 * STEP_S else 0)
    if kills > 0 and now.memory_limit:
        times = "once" if kills == 1 else f"{kills} times"
        text = f"its memory ran out {times} lately (limit {_mb(now.memory_limit)})"
        yield _more_memory(subject, text, rooms, 2 * now.memory_limit)
    elif now.memory_limit and now.memory > NEARLY_FULL * now.memory_limit:
        text = f"uses {_mb(now.memory)} of its {_mb(now.memory_limit)} of memory"
        yield _more_memory(subject, text, rooms, 1.5 * now.memory_limit)
    throttled = rates_between(oldest, history.now).throttled
    if now.cpu_limit and watched >= _SOON_S and throttled > THROTTLED:
        better = _steps(now.cpu_limit * (1 + throttled), _CORES_STEP)
        limit = write_cores(now.cpu_limit)
        text = f"was held back by its limit of {limit} cores for {throttled:.0%} of the time"
        change = f"--cpu {write_cores(better)}"
        yield _grow(subject, text, change, replace(subject.requested, cpu=better), rooms)


def _more_memory(subject: Subject, text: str, rooms: _Rooms, better: float) -> Advice:
    memory = int(_steps(better, _MEMORY_STEP))
    grown = replace(subject.requested, memory=memory)
    return _grow(subject, text, f"--memory {write_memory(memory)}", grown, rooms)


def _grow(subject: Subject, text: str, change: str, grown: Resources, rooms: _Rooms) -> Advice:
    room, requested, command = rooms.own, subject.requested, subject.command("resize", change)
    if room is not None and (lacks := room.without(requested).shortages(grown, requested)):
        text += f"; its machine has no room for more ({room.name} {' and '.join(lacks)})"
        elsewhere = next((one for one in rooms.others if one is not room and one.fits(grown)), None)
        if elsewhere is not None:
            text += f", {elsewhere.name} has; an administrator can move it there first"
            command = f"{subject.command('move', f'{elsewhere.name} --wait')} && {command}"
    return Advice("too small", text, command)


def _too_large(subject: Subject, history: History) -> Iterator[Advice]:
    requested, now, samples = subject.requested, history.now.usage, history.samples
    watched = history.now.time - samples[0].time
    if watched < OBSERVED_S:
        return
    lately = f"in the last {watched / 60:.0f} min"
    cores = max(rates_between(a, b).cpu for a, b in pairwise(samples))
    memory = history.most_memory
    if requested.cpu and cores < HARDLY_USED * requested.cpu:
        better = max(_CORES_STEP, _steps(2 * cores, _CORES_STEP))
        if better < requested.cpu:
            text = f"used at most {write_cores(cores)} of its {write_cores(requested.cpu)} cores {lately}"
            yield Advice("too large", text, subject.command("resize", f"--cpu {write_cores(better)}"))
    if requested.memory and memory < HARDLY_USED * requested.memory:
        needed = max(MIN_MEMORY, int(_steps(2 * memory, _MEMORY_STEP)))
        if needed < requested.memory:
            text = f"used at most {_mb(memory)} of its {_mb(requested.memory)} of memory {lately}"
            yield Advice("too large", text, subject.command("resize", f"--memory {write_memory(needed)}"))
    if requested.size > 1 and not requested.cpu and not requested.memory and now.memory_limit:
        slots = now.memory_limit / requested.size
        if memory < HARDLY_USED * now.memory_limit and cores < HARDLY_USED * requested.size:
            better_size = max(1, math.ceil(2 * memory / slots))
            text = f"takes {requested.size} slots and used at most {_mb(memory)} of memory {lately}"
            yield Advice("too large", text, subject.command("resize", f"--size {better_size}"))


class Movable(NamedTuple):
    """A container that can be moved without others."""

    user: str
    tag: str
    requested: Resources


def for_machine(room: Room, others: Sequence[Room], containers: Iterable[Movable] = ()) -> list[Advice]:
    """Return advice on whether a machine is too full.

    Args:
        room: The machine.
        others: Machines that containers could move to, the emptiest first; it may be among them.
        containers: Containers of the machine that may be moved.
    """
    if not is_too_full(room):
        return []
    full = {name: share for name, share in room.shares.items() if share > NEARLY_FULL}
    text = " and ".join(f"{share:.0%} of its {name}" for name, share in full.items()) + " are promised"
    move = min(_moves(room, others, containers), default=None)
    if move is not None:
        return [move.advice(text)]
    relief = next((other for other in others if other is not room and not other.draining), None)
    if relief is None or relief.load > NEARLY_FULL:
        return [Advice("too full", f"{text}, and no machine is emptier: add one", "rce-container MASTER_IP")]
    text += f"; new containers go to {relief.name}, and smaller ones make room here"
    return [Advice("too full", text, "rce top --sort memory")]


def is_too_full(room: Room) -> bool:
    """Return whether more of a machine is promised than should be; one that is emptied does not count."""
    return not room.draining and _fullest(room) > NEARLY_FULL


class _Move(NamedTuple):
    """A move that relieves a machine; the better one is less."""

    left: float
    """What is promised of what the machine is shortest of then; 0: enough is free."""
    moved: float
    """Share of the machine that moves."""
    load: float
    """Of the other machine, then."""
    user: str
    tag: str
    machine: str

    def advice(self, text: str) -> Advice:
        text += (
            f"; {self.machine} has room for {self.user}/{self.tag}, and is {self.load:.0%} full with it"
            " (what its nodes hold in memory only is lost)"
        )
        return Advice("too full", text, f"rce move {self.tag} {self.machine} --user {self.user}")


def _moves(room: Room, others: Sequence[Room], containers: Iterable[Movable]) -> Iterator[_Move]:
    """Give each container's move to the emptiest machine that takes it and is not too full then."""
    before = _fullest(room)
    for user, tag, requested in containers:
        left = _fullest(room.without(requested))
        moved = before - left
        if moved <= 0:  # it takes nothing of what the machine is short of
            continue
        for other in others:
            if other.load > NEARLY_FULL:  # so are those behind it
                break
            if other is room or not other.fits(requested):
                continue
            if (load := other.load_with(requested)) <= NEARLY_FULL:
                yield _Move(left if left > NEARLY_FULL else 0.0, moved, load, user, tag, other.name)
                break


def _fullest(room: Room) -> float:
    return max(room.shares.values(), default=0.0)


def _steps(value: float, step: float) -> float:
    return math.ceil(value / step - 1e-9) * step


def _mb(count: int) -> str:
    return f"{count / MEGABYTE:.0f} MB"
