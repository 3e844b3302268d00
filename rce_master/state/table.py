"""One table of the state: records by key, indexes, and their form in the store."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

R = TypeVar("R")


class _Index:
    """Keys by value, in the order of arrival.

    Many values have one key only: a dict for each of them would be a tenth of the memory of a large state.
    """

    def __init__(self) -> None:
        self._keys: dict[str, str | dict[str, None]] = {}

    def __iter__(self) -> Iterator[str]:
        return iter(self._keys)

    def keys(self, value: str) -> Collection[str]:
        """Return the keys of a value."""
        found = self._keys.get(value, ())
        return (found,) if isinstance(found, str) else found

    def add(self, value: str, key: str) -> None:
        """Add a key to a value."""
        found = self._keys.get(value)
        if found is None:
            self._keys[value] = key
        elif isinstance(found, str):
            # Dicts instead of sets keep the order, so that everything stays reproducible.
            self._keys[value] = {found: None, key: None}
        else:
            found[key] = None

    def remove(self, value: str, key: str) -> None:
        """Remove a key from a value."""
        found = self._keys[value]
        if isinstance(found, str):
            del self._keys[value]
            return
        del found[key]
        if not found:
            del self._keys[value]


class Table(Generic[R]):
    """Records by key, with indexes that are always up to date.

    Args:
        name: Name in the store.
        persistent: Whether the records go to the store.
        type_: What records are decoded as.
        key: Tells a record's key.
        order: Tells a record's place among those that are loaded; without it they come as the store has them.
        amount: Tells what a record adds to the total of which key.
        share: Called with key, record and the row's size in bytes when a record was decoded, before it is
            kept; puts equal values in place of parts of it.
        indexes: By name.
    """

    def __init__(
        self,
        name: str,
        *,
        type_: Any,
        key: Callable[[R], str],
        persistent: bool = True,
        order: Callable[[R], int] | None = None,
        amount: Callable[[R], tuple[str, int]] | None = None,
        share: Callable[[str, R, int], None] | None = None,
        **indexes: Callable[[R], Iterable[str]],
    ) -> None:
        self.name = name
        self.persistent = persistent
        self.key = key
        self._decoder = msgspec.json.Decoder(type_)
        self._rows: dict[str, R] = {}
        self._order = order
        self._amount = amount
        self._share = share
        self._totals: dict[str, int] = {}
        self._indexes = indexes
        self._found = {name: _Index() for name in indexes}
        self._watchers: list[Callable[[R | None, R | None], None]] = []

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def __iter__(self) -> Iterator[R]:
        return iter(self._rows.values())

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, key: str) -> R:
        return self._rows[key]

    def get(self, key: str) -> R | None:
        """Find a record."""
        return self._rows.get(key)

    def by(self, index: str, value: str) -> list[R]:
        """List the records that an index finds for a value, in order of arrival."""
        return [self._rows[key] for key in self._found[index].keys(value)]

    def keys(self, index: str, value: str) -> Iterable[str]:
        """Return the keys of the records that an index finds for a value, in order of arrival."""
        return self._found[index].keys(value)

    def count(self, index: str, value: str) -> int:
        """Tell how many records an index finds for a value."""
        return len(self._found[index].keys(value))

    def total(self, key: str) -> int:
        """Return the sum of what the records add to a key."""
        return self._totals.get(key, 0)

    def assign(self, key: str, record: R | None) -> None:
        """Put a record in place of what was there; None removes it."""
        before = self._rows.pop(key, None) if record is None else self._rows.get(key)
        for name, of in self._indexes.items():
            old = () if before is None else tuple(of(before))
            new = () if record is None else tuple(of(record))
            if old != new:
                for value in old:
                    self._found[name].remove(value, key)
                for value in new:
                    self._found[name].add(value, key)
        self._count(before, -1)
        self._count(record, 1)
        if record is not None:
            self._rows[key] = record
        for watcher in self._watchers:
            watcher(before, record)

    def watch(self, watcher: Callable[[R | None, R | None], None]) -> None:
        """Call a function after each write, also of one that is undone, with the record before and after it.

        For what is derived from several tables, as an index is from one.
        """
        self._watchers.append(watcher)

    def encode(self, record: R) -> bytes:
        """Encode a record for the store."""
        return msgspec.json.encode(record)

    def reading(self, rows: Mapping[str, bytes], piece: int) -> Iterator[None]:
        """Fill the table from the store, with a pause after each piece.

        Args:
            rows: Key to encoded record.
            piece: Number of rows.

        Raises:
            msgspec.ValidationError: A record cannot be read.
        """
        records = []
        for number, (key, body) in enumerate(rows.items(), 1):
            records.append((key, self._decode(key, body)))
            if number % piece == 0:
                yield
        if (order := self._order) is not None:
            records.sort(key=lambda item: order(item[1]))
        for number, (key, record) in enumerate(records, 1):
            self.assign(key, record)
            if number % piece == 0:
                yield

    def write(self, key: str, body: bytes | None) -> None:
        """Write a row as the store has it; None removes it.

        Raises:
            msgspec.ValidationError: The record cannot be read.
        """
        if body is not None:
            self.assign(key, self._decode(key, body))
        elif key in self._rows:
            self.assign(key, None)

    def index_entries(self, index: str) -> dict[str, list[str]]:
        """Show an index: value to keys."""
        found = self._found[index]
        return {value: list(found.keys(value)) for value in found}

    def computed_entries(self, index: str) -> dict[str, list[str]]:
        """Compute again what :meth:`index_entries` must hold, up to the order."""
        entries: dict[str, list[str]] = {}
        for key, record in self._rows.items():
            for value in self._indexes[index](record):
                entries.setdefault(value, []).append(key)
        return entries

    @property
    def indexes(self) -> tuple[str, ...]:
        """Names of the indexes."""
        return tuple(self._indexes)

    @property
    def totals(self) -> dict[str, int]:
        """What :meth:`total` returns, by key."""
        return dict(self._totals)

    @property
    def computed_totals(self) -> dict[str, int]:
        """Compute again what :attr:`totals` must hold."""
        totals: dict[str, int] = {}
        for record in self._rows.values():
            if self._amount is not None:
                key, amount = self._amount(record)
                totals[key] = totals.get(key, 0) + amount
        return {key: total for key, total in totals.items() if total}

    def _decode(self, key: str, body: bytes) -> R:
        record: R = self._decoder.decode(body)
        if self._share is not None:
            self._share(key, record, len(body))
        return record

    def _count(self, record: R | None, sign: int) -> None:
        if record is None or self._amount is None:
            return
        key, amount = self._amount(record)
        total = self._totals.get(key, 0) + sign * amount
        if total:
            self._totals[key] = total
        else:
            self._totals.pop(key, None)
