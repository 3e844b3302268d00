"""The tables that hold the state's records, and what is derived from them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.control import TaskSetKind
from rce_master.state.lifecycle import RobotSession
from rce_master.state.package_uses import PackageUses
from rce_master.state.promises import Promises
from rce_master.state.records import (
    Container,
    ContainerLive,
    Counter,
    Departure,
    Drain,
    Endpoint,
    Live,
    Lockout,
    Move,
    Presence,
    Robot,
    RobotLive,
    TaskSet,
    Tombstone,
)
from rce_master.state.rooms import Rooms
from rce_master.state.sharing import Sharing
from rce_master.state.table import Table
from rce_master.state.user_records import (
    KeptAnswer,
    KnownLogin,
    PackageKey,
    Token,
    User,
    UserLimits,
    UserPackage,
)
from rce_master.state.volume_records import SavedState, UserVolume, VolumeMove, VolumeRemoval, user_volume_key
from rce_master.state.waiting import PlacementQueue, group_key
from rce_master.state.wiring_records import (
    ActiveInterface,
    Connection,
    Interface,
    Link,
    OpenEnd,
    interface_key,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce.model import InterfaceSpec

WAITING = "waiting"
"""The only value of the indexes ``untold`` and ``unsettled`` of ``live``."""


class Tables:
    """All tables.

    - ``known_logins``, ``user_limits``: at most one for each user.
    - ``answers``: only of users that are there.
    - ``endpoints``: robots and containers; both in one table, because a tag is unique among both.
    - ``volumes``: every volume of every container, and those that containers left.
    - ``volume_removals``: also of task sets that are gone: they may come back.
    - ``saved_states``: only of containers that are there; at most one for each node.
    - ``interfaces``: only of endpoints that are there.
    - ``links``: one for each pair of endpoints that has a connection.
    - ``connections``: only on links that are there, between interfaces that are there.
    - ``live``: exactly one record for each endpoint.
    - ``active``, ``open_ends``: only of endpoints of which a status is known.
    - ``presence``: exactly one record for each task set.
    - ``lockouts``: of users until no session is left that is to end.
    - ``tombstones``: only of connected task sets.
    - ``drains``: also of container task sets that are gone: they may come back.
    - ``moves``: only of containers that are placed, to task sets that are connected.
    - ``volume_moves``: only of containers with volumes.
    """

    def __init__(self) -> None:
        sharing = Sharing(self._kept_id)
        self.users = Table[User]("users", type_=User, key=lambda u: u.name)
        self.tokens = Table[Token]("tokens", type_=Token, key=lambda t: t.digest, user=lambda t: [t.user])
        self.known_logins = Table[KnownLogin]("known_logins", type_=KnownLogin, key=lambda k: k.user)
        self.user_limits = Table[UserLimits]("user_limits", type_=UserLimits, key=lambda u: u.user)
        self.answers = Table[KeptAnswer](
            "answers",
            type_=KeptAnswer,
            key=lambda a: a.id,
            order=lambda a: int(a.created * 1000),
            user=lambda a: [a.user],
        )
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
            "volumes",
            type_=UserVolume,
            key=lambda v: v.id,
            user=lambda v: [v.user],
            process=lambda v: [v.process],
            snapshot=lambda v: [v.snapshot] if v.snapshot else [],
        )
        self.volume_removals = Table[VolumeRemoval](
            "volume_removals", type_=VolumeRemoval, key=lambda r: r.id, process=lambda r: [r.process]
        )
        self.saved_states = Table[SavedState](
            "saved_states",
            type_=SavedState,
            key=lambda s: s.id,
            amount=lambda s: (s.user, s.size),
            user=lambda s: [s.user],
            container=lambda s: [s.container],
            sha256=lambda s: [s.sha256],
        )
        self.endpoints = Table[Endpoint](
            "endpoints",
            type_=Robot | Container,
            key=lambda e: e.id,
            amount=lambda e: (e.user, e.size),
            share=sharing.endpoint,
            user=lambda e: [e.user],
            robots_of=lambda e: [e.user] if isinstance(e, Robot) else [],
            task_set=lambda e: [e.task_set],
            containers_of=lambda e: [e.user] if isinstance(e, Container) else [],
            group=_groups,
            volume=_volumes,
        )
        self.interfaces = Table[Interface](
            "interfaces",
            type_=Interface,
            key=lambda i: i.id,
            order=lambda i: i.number,
            share=sharing.interface,
            endpoint=lambda i: [i.endpoint],
            user=lambda i: [i.endpoint.partition("/")[0]],
        )
        self.links = Table[Link](
            "links",
            type_=Link,
            key=lambda k: k.id,
            share=sharing.link,
            endpoint=lambda k: dict.fromkeys((k.a, k.b)),
            pair=lambda k: [f"{k.a} {k.b}"],
        )
        self.connections = Table[Connection](
            "connections",
            type_=Connection,
            key=lambda c: str(c.id),
            order=lambda c: c.id,
            share=sharing.connection,
            user=lambda c: [c.a.partition("/")[0]],
            link=lambda c: [c.link],
            endpoint=lambda c: dict.fromkeys((c.a, c.b)),
            end=lambda c: dict.fromkeys(c.ends),
            ends=lambda c: [" ".join(c.ends)],
        )
        self.task_sets = Table[TaskSet](
            "task_sets",
            type_=TaskSet,
            key=lambda s: s.process,
            machine=lambda s: [s.machine.name] if s.kind is TaskSetKind.CONTAINER else [],
        )
        self.counters = Table[Counter]("counters", type_=Counter, key=lambda c: c.name)
        self.drains = Table[Drain]("drains", type_=Drain, key=lambda d: d.process)
        self.volume_moves = Table[VolumeMove](
            "volume_moves", type_=VolumeMove, key=lambda m: m.id, to=lambda m: [m.to]
        )
        self.live = Table[Live](
            "live", type_=Any, key=lambda o: o.id, persistent=False, untold=_untold, unsettled=_unsettled
        )
        self.active = Table[ActiveInterface](
            "active", type_=Any, key=lambda a: a.id, persistent=False, endpoint=lambda a: [a.endpoint]
        )
        self.open_ends = Table[OpenEnd](
            "open_ends", type_=Any, key=lambda o: o.id, persistent=False, endpoint=lambda o: [o.endpoint]
        )
        self.presence = Table[Presence]("presence", type_=Any, key=lambda p: p.process, persistent=False)
        self.lockouts = Table[Lockout]("lockouts", type_=Any, key=lambda o: o.user, persistent=False)
        self.tombstones = Table[Tombstone](
            "tombstones", type_=Any, key=lambda t: t.key, persistent=False, process=lambda t: [t.process]
        )
        self.moves = Table[Move](
            "moves", type_=Any, key=lambda m: m.id, persistent=False, to=lambda m: [m.to]
        )
        self.departures = Table[Departure](
            "departures", type_=Any, key=lambda d: d.id, persistent=False, process=lambda d: [d.process]
        )
        self.first_revision = 0
        """Revisions that this run of the master gives are above this."""
        self.queue = PlacementQueue(self.endpoints, self.tombstones, self.volume_removals)
        self.rooms = Rooms(
            endpoints=self.endpoints,
            moves=self.moves,
            volume_moves=self.volume_moves,
            task_sets=self.task_sets,
            presence=self.presence,
            drains=self.drains,
            on_gain=self.queue.offer,
        )
        self.package_uses = PackageUses(self.endpoints)
        self.requested = Promises()
        """What each user's containers ask for."""
        self.endpoints.watch(self._count_requests)
        self.drain_round: dict[str, int] = {}
        """Draining machines that have to be looked at, with the number of the last container there."""

    @property
    def all(self) -> tuple[Table[Any], ...]:
        """Every table."""
        return (
            self.users,
            self.tokens,
            self.known_logins,
            self.user_limits,
            self.answers,
            self.package_keys,
            self.packages,
            self.volumes,
            self.volume_removals,
            self.saved_states,
            self.endpoints,
            self.interfaces,
            self.links,
            self.connections,
            self.task_sets,
            self.counters,
            self.drains,
            self.volume_moves,
            self.live,
            self.active,
            self.open_ends,
            self.presence,
            self.lockouts,
            self.tombstones,
            self.moves,
            self.departures,
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
        found = self.endpoints if user is None else self.endpoints.by("robots_of", user)
        return [e for e in found if isinstance(e, Robot)]

    def containers(self, user: str | None = None) -> list[Container]:
        """List the containers, of one user or of all."""
        found = self.endpoints if user is None else self.endpoints.by("containers_of", user)
        return [e for e in found if isinstance(e, Container)]

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

    def _kept_id(self, endpoint: str) -> str:
        found = self.endpoints.get(endpoint)
        return endpoint if found is None else found.id

    def _count_requests(self, before: Endpoint | None, after: Endpoint | None) -> None:
        was = before if isinstance(before, Container) else None
        now = after if isinstance(after, Container) else None
        if was is not None and now is not None and was.resources == now.resources:
            return
        if was is not None:
            self.requested.remove(was.user, was.resources)
        if now is not None:
            self.requested.add(now.user, now.resources)


def _groups(endpoint: Endpoint) -> list[str]:
    key = group_key(endpoint) if isinstance(endpoint, Container) else ""
    return [key] if key else []


def _volumes(endpoint: Endpoint) -> Iterable[str]:
    volumes = endpoint.resources.volumes if isinstance(endpoint, Container) else ()
    return dict.fromkeys(user_volume_key(endpoint.user, volume.name) for volume in volumes)


def _untold(live: Live) -> list[str]:
    """Index containers that wait, and whose users were not told."""
    waits = isinstance(live, ContainerLive) and not live.told and not live.phase.is_placed
    return [WAITING] if waits else []


def _unsettled(live: Live) -> list[str]:
    """Index robots for which a time runs: they are absent, or were admitted and not reported yet."""
    runs = isinstance(live, RobotLive) and (live.session is RobotSession.ABSENT or live.status is None)
    return [WAITING] if runs else []
