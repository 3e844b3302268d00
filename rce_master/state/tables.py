"""The tables that hold the state's records, their indexes, and their form in the store."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec

from rce_master.state.records import (
    Container,
    ContainerLive,
    Counter,
    Drain,
    Endpoint,
    KnownLogin,
    Live,
    Move,
    PackageKey,
    Presence,
    Robot,
    RobotLive,
    TaskSet,
    Token,
    Tombstone,
    User,
    UserLimits,
    UserPackage,
    UserVolume,
    VolumeRemoval,
)
from rce_master.state.wiring_records import (
    ActiveInterface,
    Connection,
    Interface,
    Link,
    OpenEnd,
    interface_key,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rce.model import InterfaceSpec

R = TypeVar("R")


class Table(Generic[R]):
    """Records by key, with indexes that are always up to date.

    Args:
        name: Name in the store.
        persistent: Whether the records go to the store.
        type_: What records are decoded as.
        key: Tells a record's key.
        order: Tells a record's place among those that are loaded; without it they come as the store has them.
        amount: Tells what a record adds to the total of which key.
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
        **indexes: Callable[[R], Iterable[str]],
    ) -> None:
        self.name = name
        self.persistent = persistent
        self.key = key
        self._decoder = msgspec.json.Decoder(type_)
        self._rows: dict[str, R] = {}
        self._order = order
        self._amount = amount
        self._totals: dict[str, int] = {}
        self._indexes = indexes
        # Inner dicts instead of sets keep the order of arrival, so that everything stays reproducible.
        self._found: dict[str, dict[str, dict[str, None]]] = {name: {} for name in indexes}

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
        return [self._rows[key] for key in self._found[index].get(value, ())]

    def count(self, index: str, value: str) -> int:
        """Tell how many records an index finds for a value."""
        return len(self._found[index].get(value, ()))

    def total(self, key: str) -> int:
        """Return the sum of what the records add to a key."""
        return self._totals.get(key, 0)

    def assign(self, key: str, record: R | None) -> None:
        """Put a record in place of what was there; None removes it."""
        before = self._rows.pop(key, None) if record is None else self._rows.get(key)
        for name, of in self._indexes.items():
            old = () if before is None else of(before)
            new = () if record is None else of(record)
            self._reindex(self._found[name], key, list(old), list(new))
        self._count(before, -1)
        self._count(record, 1)
        if record is not None:
            self._rows[key] = record

    def encode(self, record: R) -> bytes:
        """Encode a record for the store."""
        return msgspec.json.encode(record)

    def load(self, rows: Mapping[str, bytes]) -> None:
        """Fill the table from the store.

        Raises:
            msgspec.ValidationError: A record cannot be read.
        """
        records = [(key, self._decoder.decode(body)) for key, body in rows.items()]
        if (order := self._order) is not None:
            records.sort(key=lambda item: order(item[1]))
        for key, record in records:
            self.assign(key, record)

    def index_entries(self, index: str) -> dict[str, list[str]]:
        """Show an index: value to keys."""
        return {value: list(keys) for value, keys in self._found[index].items()}

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

    def _count(self, record: R | None, sign: int) -> None:
        if record is None or self._amount is None:
            return
        key, amount = self._amount(record)
        total = self._totals.get(key, 0) + sign * amount
        if total:
            self._totals[key] = total
        else:
            self._totals.pop(key, None)

    @staticmethod
    def _reindex(entries: dict[str, dict[str, None]], key: str, before: list[str], after: list[str]) -> None:
        if before == after:
            return
        for value in before:
            del entries[value][key]
            if not entries[value]:
                del entries[value]
        for value in after:
            entries.setdefault(value, {})[key] = None


class Tables:
    """All tables.

    - ``known_logins``, ``user_limits``: at most one for each user.
    - ``endpoints``: robots and containers; both in one table, because a tag is unique among both.
    - ``volumes``: every volume of every container, and those that containers left.
    - ``volume_removals``: also of task sets that are gone: they may come back.
    - ``interfaces``: only of endpoints that are there.
    - ``links``: one for each pair of endpoints that has a connection.
    - ``connections``: only on links that are there, between interfaces that are there.
    - ``live``: exactly one record for each endpoint.
    - ``active``, ``open_ends``: only of endpoints of which a status is known.
    - ``presence``: exactly one record for each task set.
    - ``tombstones``: only of connected task sets.
    - ``drains``: also of task sets that are gone: they may come back.
    - ``moves``: only of containers that are placed, to task sets that are connected.
    """

    def __init__(self) -> None:
        self.users = Table[User]("users", type_=User, key=lambda u: u.name)
        self.tokens = Table[Token]("tokens", type_=Token, key=lambda t: t.digest, user=lambda t: [t.user])
        self.known_logins = Table[KnownLogin]("known_logins", type_=KnownLogin, key=lambda k: k.user)
        self.user_limits = Table[UserLimits]("user_limits", type_=UserLimits, key=lambda u: u.user)
        self.package_keys = Table[PackageKey](
            "package_keys", type_=PackageKey, key=lambda k: k.id, user=lambda k: [k.user]
        )
        self.packages = Table[UserPackage](
            "bundles",
            type_=UserPackage,
            key=lambda b: b.id,
            user=lambda b: [b.user],
            package=lambda b: [f"{b.user}/{b.name}"],
            sha256=lambda b: [b.sha256],
        )
        self.volumes = Table[UserVolume](
            "volumes", type_=UserVolume, key=lambda v: v.id, user=lambda v: [v.user]
        )
        self.volume_removals = Table[VolumeRemoval](
            "volume_removals", type_=VolumeRemoval, key=lambda r: r.id, process=lambda r: [r.process]
        )
        self.endpoints = Table[Endpoint](
            "endpoints",
            type_=Robot | Container,
            key=lambda e: e.id,
            amount=lambda e: (e.user, e.size),
            user=lambda e: [e.user],
            robots_of=lambda e: [e.user] if isinstance(e, Robot) else [],
            task_set=lambda e: [e.task_set],
        )
        self.interfaces = Table[Interface](
            "interfaces",
            type_=Interface,
            key=lambda i: i.id,
            order=lambda i: i.number,
            endpoint=lambda i: [i.endpoint],
            user=lambda i: [i.endpoint.partition("/")[0]],
        )
        self.links = Table[Link](
            "links",
            type_=Link,
            key=lambda k: k.id,
            endpoint=lambda k: dict.fromkeys((k.a, k.b)),
            pair=lambda k: [f"{k.a} {k.b}"],
        )
        self.connections = Table[Connection](
            "connections",
            type_=Connection,
            key=lambda c: str(c.id),
            order=lambda c: c.id,
            user=lambda c: [c.a.partition("/")[0]],
            link=lambda c: [c.link],
            endpoint=lambda c: dict.fromkeys((c.a, c.b)),
            end=lambda c: dict.fromkeys(c.ends),
            ends=lambda c: [" ".join(c.ends)],
        )
        self.task_sets = Table[TaskSet]("task_sets", type_=TaskSet, key=lambda s: s.process)
        self.counters = Table[Counter]("counters", type_=Counter, key=lambda c: c.name)
        self.drains = Table[Drain]("drains", type_=Drain, key=lambda d: d.process)
        self.live = Table[Live]("live", type_=Any, key=lambda o: o.id, persistent=False)
        self.active = Table[ActiveInterface](
            "active", type_=Any, key=lambda a: a.id, persistent=False, endpoint=lambda a: [a.endpoint]
        )
        self.open_ends = Table[OpenEnd](
            "open_ends", type_=Any, key=lambda o: o.id, persistent=False, endpoint=lambda o: [o.endpoint]
        )
        self.presence = Table[Presence]("presence", type_=Any, key=lambda p: p.process, persistent=False)
        self.tombstones = Table[Tombstone](
            "tombstones", type_=Any, key=lambda t: t.key, persistent=False, process=lambda t: [t.process]
        )
        self.moves = Table[Move](
            "moves", type_=Any, key=lambda m: m.id, persistent=False, to=lambda m: [m.to]
        )
        self.first_revision = 0
        """Revisions that this run of the master gives are above this."""

    @property
    def all(self) -> tuple[Table[Any], ...]:
        """Every table."""
        return (
            self.users,
            self.tokens,
            self.known_logins,
            self.user_limits,
            self.package_keys,
            self.packages,
            self.volumes,
            self.volume_removals,
            self.endpoints,
            self.interfaces,
            self.links,
            self.connections,
            self.task_sets,
            self.counters,
            self.drains,
            self.live,
            self.active,
            self.open_ends,
            self.presence,
            self.tombstones,
            self.moves,
        )

    def robot(self, endpoint: str) -> Robot | None:
        """Find a robot by its endpoint id."""
        found = self.endpoints.get(endpoint)
        return found if isinstance(found, Robot) else None

    def container(self, endpoint: str) -> Container | None:
        """Find a container by its endpoint id."""
        found = self.endpoints.get(endpoint)
        return found if isinstance(found, Container) else None

    def robots(self, user: str | None = None) -> list[Robot]:
        """List the robots, of one user or of all."""
        return [e for e in self._of(user) if isinstance(e, Robot)]

    def containers(self, user: str | None = None) -> list[Container]:
        """List the containers, of one user or of all."""
        return [e for e in self._of(user) if isinstance(e, Container)]

    def robot_live(self, endpoint: str) -> RobotLive:
        """Tell what is observed of a robot."""
        live = self.live[endpoint]
        assert isinstance(live, RobotLive)
        return live

    def container_live(self, endpoint: str) -> ContainerLive:
        """Tell what is observed of a container."""
        live = self.live[endpoint]
        assert isinstance(live, ContainerLive)
        return live

    def is_connected(self, process: str) -> bool:
        """Tell whether a task set is connected."""
        presence = self.presence.get(process)
        return presence is not None and presence.connected

    def link_between(self, one: str, other: str) -> Link | None:
        """Find the link of two endpoints."""
        return next(iter(self.links.by("pair", " ".join(sorted((one, other))))), None)

    def interface(self, endpoint: str, tag: str) -> InterfaceSpec | None:
        """Find an interface of an endpoint."""
        found = self.interfaces.get(interface_key(endpoint, tag))
        return None if found is None else found.spec

    def _of(self, user: str | None) -> Iterable[Endpoint]:
        return self.endpoints if user is None else self.endpoints.by("user", user)
