"""Puts binary frames into the messages that refer to them.

Any value of a JSON object may travel as a binary frame of its own: 32 ASCII hex characters, the *id*,
followed by the bytes. The object then holds ``"key*": id`` instead of ``"key"``, or ``"key*": [ids]`` for a
list of binary values. The frames of a message may arrive in any order and mixed with those of others.

Invariants: every id is awaited by at most one message; an unclaimed value is awaited by none;
``pending_bytes`` is the sum over all incomplete messages (their memory and the values they have got) and all
unclaimed values; both stay within the limits after every call.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from rce.model.spelling import short
from rce.protocol.exceptions import AssemblyError
from rce.protocol.limits import DEFAULT_LIMITS, Limits

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

ID_LENGTH = 32
"""Length of the id at the start of a binary frame, in bytes."""

PLACE_BYTES = 512
"""Memory of the place of a binary value in an incomplete message, whether the value has come or not."""
_ID = re.compile(r"[0-9A-Fa-f]{32}")
_ID_BYTES = re.compile(rb"[0-9A-Fa-f]{32}")

Binary: TypeAlias = bytes | bytearray | memoryview


class Dropped(NamedTuple):
    """An incomplete message or a binary value that was dropped."""

    text: str
    """Why."""
    value: Any = None
    """The incomplete message; ``None`` for a binary value that no message asked for."""


@dataclass(eq=False, slots=True)
class _Partial:
    """A message that waits for binary values."""

    value: Any
    size: int
    deadline: float
    places: dict[str, tuple[Any, Any]]
    """Id to the container and key (or index) where its value belongs."""
    missing: set[str] = field(default_factory=set)


@dataclass(eq=False, slots=True)
class _Unclaimed:
    """A binary value that no message has asked for yet."""

    id: str
    data: memoryview
    size: int
    deadline: float


class Assembler:
    """Joins parsed text frames with binary frames. Pure: time comes in as ``now``, in seconds."""

    def __init__(self, limits: Limits = DEFAULT_LIMITS) -> None:
        self._limits = limits
        self._entries: dict[int, _Partial | _Unclaimed] = {}  # oldest first
        self._awaited: dict[str, _Partial] = {}
        self._unclaimed: dict[str, _Unclaimed] = {}
        self.pending_bytes = 0
        """Bytes of incomplete messages and unclaimed values."""

    def __len__(self) -> int:
        """Count the incomplete messages and unclaimed values."""
        return len(self._entries)

    @property
    def next_deadline(self) -> float | None:
        """When :meth:`expire` must be called next; None if nothing waits."""
        oldest = next(iter(self._entries.values()), None)
        return None if oldest is None else oldest.deadline

    def add_message(self, value: Any, size: int, now: float) -> tuple[bool, list[Dropped]]:
        """Take a parsed text frame.

        Args:
            value: The JSON value; starred keys in it are replaced in place.
            size: Bytes of memory that it counts.
            now: Seconds on the caller's clock.

        Returns:
            Whether ``value`` is complete, and everything that had to be dropped.

        Raises:
            AssemblyError: A reference in it is wrong; the message is refused.
        """
        return self._await(value, self._claim_places(value), size, now)

    def add_single(
        self, value: Any, id_: str, holder: list[Any], size: int, now: float
    ) -> tuple[bool, list[Dropped]]:
        """Take a message that is known to refer to one binary value only.

        Args:
            value: What :meth:`add_binary` returns when it is complete.
            id_: The id that it refers to, 32 hexadecimal characters.
            holder: A list of one element, where the binary value is put.
            size: As for :meth:`add_message`.
            now: Seconds on the caller's clock.

        Returns:
            As :meth:`add_message`.

        Raises:
            AssemblyError: Another message refers to that id.
        """
        if id_ in self._awaited:
            raise AssemblyError(f"binary value {id_} is referred to twice")
        return self._await(value, {id_: (holder, 0)}, size, now)

    def add_references(
        self, value: Any, ids: Collection[str], holder: dict[str, Any], size: int, now: float
    ) -> tuple[bool, list[Dropped]]:
        """Take a message whose references to binary values are known.

        Args:
            value: What :meth:`add_binary` returns when it is complete.
            ids: The ids of these values, each 32 hexadecimal characters.
            holder: Where the binary values are put, by id.
            size: As for :meth:`add_message`.
            now: Seconds on the caller's clock.

        Returns:
            As :meth:`add_message`.

        Raises:
            AssemblyError: Another message refers to one of the ids.
        """
        for id_ in ids:
            if id_ in self._awaited:
                raise AssemblyError(f"binary value {id_} is referred to twice")
        return self._await(value, {id_: (holder, id_) for id_ in ids}, size, now)

    @property
    def awaited(self) -> list[str]:
        """The ids of the binary values that messages wait for."""
        return list(self._awaited)

    def _await(
        self, value: Any, places: dict[str, tuple[Any, Any]], size: int, now: float
    ) -> tuple[bool, list[Dropped]]:
        """Insert the values that have come already, and wait for the rest."""
        found = [self._unclaimed[id_] for id_ in places if id_ in self._unclaimed]
        for unclaimed in found:
            self._forget(unclaimed)
            _put(places[unclaimed.id], unclaimed.data)
        if len(found) == len(places):
            return True, []
        partial = _Partial(
            value,
            size + PLACE_BYTES * len(places) + sum(unclaimed.size for unclaimed in found),
            now + self._limits.expiry,
            places,
            set(places).difference(unclaimed.id for unclaimed in found),
        )
        self._awaited.update(dict.fromkeys(partial.missing, partial))
        return False, self._keep(partial)

    def add_binary(self, frame: Binary, now: float) -> tuple[Any, list[Dropped]]:
        """Take a binary frame.

        Args:
            frame: The id and the bytes after it; kept, not copied.
            now: Seconds on the caller's clock.

        Returns:
            The message that this frame completed (``None`` if it completed none), and everything that had to
            be dropped.

        Raises:
            AssemblyError: The frame is wrong, or its id was there already.
        """
        if not _ID_BYTES.match(frame):
            raise AssemblyError(f"a binary frame must start with {ID_LENGTH} hexadecimal characters")
        id_ = bytes(frame[:ID_LENGTH]).decode("ascii")
        data = memoryview(frame)[ID_LENGTH:]
        partial = self._awaited.pop(id_, None)
        if partial is None:
            if id_ in self._unclaimed:
                raise AssemblyError(f"binary value {id_} came twice")
            unclaimed = _Unclaimed(id_, data, len(frame), now + self._limits.expiry)
            self._unclaimed[id_] = unclaimed
            return None, self._keep(unclaimed)
        _put(partial.places[id_], data)
        partial.missing.discard(id_)
        partial.size += len(frame)
        self.pending_bytes += len(frame)
        if partial.missing:
            return None, self._shrink()
        self._forget(partial)
        return partial.value, []

    def expire(self, now: float) -> list[Dropped]:
        """Drop everything that is older than the limit; return each with the reason."""
        dropped: list[Dropped] = []
        while self._entries:
            oldest = next(iter(self._entries.values()))
            if oldest.deadline > now:
                break
            self._forget(oldest)
            dropped.append(_dropped(oldest, f"within {self._limits.expiry:g} s; dropped"))
        return dropped

    def drop_oldest(self, size: int) -> list[Dropped]:
        """Drop incomplete items, oldest first, until ``size`` bytes are free; return each with the reason."""
        goal = self.pending_bytes - size
        dropped: list[Dropped] = []
        while self._entries and self.pending_bytes > goal:
            oldest = next(iter(self._entries.values()))
            self._forget(oldest)
            dropped.append(_dropped(oldest, "and memory is short; dropped"))
        return dropped

    def _claim_places(self, value: Any) -> dict[str, tuple[Any, Any]]:
        """Replace the starred keys by empty places; check everything before anything is changed."""
        references = list(_references(value))
        places: dict[str, tuple[Any, Any]] = {}
        count = 0
        for holder, key in references:
            name = key[:-1]
            if not name or name in holder:
                problem = f"there is a value {short(name)} already" if name else "the name is missing"
                raise AssemblyError(f"{short(key)}: {problem}")
            ids = holder[key] if isinstance(holder[key], list) else [holder[key]]
            count += len(ids)
            if count > self._limits.max_references:
                raise AssemblyError(f"more than {self._limits.max_references} binary values in a message")
            for id_ in ids:
                if not isinstance(id_, str) or not _ID.fullmatch(id_):
                    raise AssemblyError(
                        f"{short(key)}: an id must be a string of {ID_LENGTH} hexadecimal characters"
                    )
                if id_ in places or id_ in self._awaited:
                    raise AssemblyError(f"{short(key)}: binary value {id_} is referred to twice")
                places[id_] = (holder, name)
        for holder, key in references:
            ids = holder.pop(key)
            holder[key[:-1]] = ids if isinstance(ids, list) else None
            if isinstance(ids, list):
                places.update((id_, (ids, index)) for index, id_ in enumerate(ids))
        return places

    def _keep(self, entry: _Partial | _Unclaimed) -> list[Dropped]:
        self._entries[id(entry)] = entry
        self.pending_bytes += entry.size
        return self._shrink()

    def _shrink(self) -> list[Dropped]:
        """Drop the oldest items until the rest is within the limits."""
        dropped: list[Dropped] = []
        limits = self._limits
        while self.pending_bytes > limits.max_pending_bytes or len(self._entries) > limits.max_pending:
            oldest = next(iter(self._entries.values()))
            self._forget(oldest)
            dropped.append(_dropped(oldest, "and too much is incomplete; the oldest was dropped"))
        return dropped

    def _forget(self, entry: _Partial | _Unclaimed) -> None:
        del self._entries[id(entry)]
        self.pending_bytes -= entry.size
        if isinstance(entry, _Unclaimed):
            del self._unclaimed[entry.id]
        else:
            for id_ in entry.missing:
                del self._awaited[id_]


def _put(place: tuple[Any, Any], data: memoryview) -> None:
    holder, key = place
    holder[key] = data


def _references(value: Any) -> Iterator[tuple[dict[str, Any], str]]:
    """Find all starred keys: pairs of the object that holds one and the key."""
    stack = [value]
    while stack:
        item = stack.pop()
        if type(item) is dict:
            for key, inner in item.items():
                if key.endswith("*"):
                    yield item, key
                elif type(inner) is dict or type(inner) is list:
                    stack.append(inner)
        elif type(item) is list:
            stack.extend(inner for inner in item if type(inner) is dict or type(inner) is list)


def _dropped(entry: _Partial | _Unclaimed, why: str) -> Dropped:
    if isinstance(entry, _Unclaimed):
        size = entry.size - ID_LENGTH
        return Dropped(f"no message asked for binary value {entry.id} ({size} bytes) {why}")
    missing = f"{len(entry.missing)} of {len(entry.places)} binary values of a message did not come"
    return Dropped(f"{missing} {why}", entry.value)
