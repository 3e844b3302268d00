"""What ``rce cluster status`` shows: the members of etcd and the masters beside them."""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import aiohttp

from rce.link.address import in_url
from rce_master.cluster.client import ANSWER_S, ClusterClient, answering, ask_all, healthy
from rce_master.cluster.members import Member, MemberStatus, advice, no_quorum
from rce_master.store.etcd.exceptions import EtcdAwayError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rce.tls import Context

_MIB = 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class MemberLine:
    """A member of etcd."""

    name: str
    address: str
    role: str
    """``leader``, ``follower``, ``learner``, or ``away``."""
    health: str
    """``ok``, or what is wrong."""
    version: str = ""
    size: int = 0
    """Of the database, bytes."""
    alarms: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MasterLine:
    """The master of a machine."""

    name: str
    url: str
    role: str
    """``leader``, ``standby``, or ``away``."""
    status: str
    """What it says of itself, or why it does not answer."""
    term: int = 0
    lag: float | None = None
    """Seconds that a stand-by is behind; None: it does not say."""
    drained: bool = False
    """Whether it leads only if no other one does."""
    version: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterReport:
    """The state of a cluster."""

    members: tuple[MemberLine, ...]
    masters: tuple[MasterLine, ...]
    advice: tuple[str, ...]
    """What the operator should do."""

    @property
    def ok(self) -> bool:
        """Whether every part works and nothing is advised."""
        parts = [line.health == "ok" and not line.alarms for line in self.members]
        return all(parts) and any(line.role == "leader" for line in self.masters) and not self.advice

    def as_json(self) -> str:
        """Return it as JSON."""
        return json.dumps({"ok": self.ok, **asdict(self)}, indent=2)

    def lines(self) -> Iterable[str]:
        """Yield it as a table."""
        rows: list[tuple[str, ...]] = [("ETCD", "ADDRESS", "ROLE", "SIZE", "VERSION", "HEALTH")]
        for each in self.members:
            size = f"{each.size / _MIB:.1f} MiB" if each.size else "-"
            health = "; ".join([each.health, *(f"alarm {alarm}" for alarm in each.alarms)])
            rows.append((each.name, each.address, each.role, size, each.version or "-", health))
        yield from _table(rows)
        yield ""
        rows = [("MASTER", "URL", "ROLE", "TERM", "LAG", "VERSION", "STATUS")]
        for one in self.masters:
            lag = "-" if one.lag is None else f"{one.lag:.1f} s"
            role = f"{one.role}, drained" if one.drained else one.role
            rows.append((one.name, one.url, role, str(one.term or "-"), lag, one.version or "-", one.status))
        yield from _table(rows)
        for text in self.advice:
            yield f"note: {text}"


async def make_report(client: ClusterClient, tls: Context | None, http_port: int) -> ClusterReport:
    """Ask all members of etcd and all masters.

    Args:
        client: A client of all members.
        tls: TLS of requests; None: plain.
        http_port: Port of the masters' HTTP servers.

    Raises:
        EtcdError: No member of etcd answers.
    """
    members = sorted(await client.members(), key=lambda member: member.name)
    answers = await ask_all(members, tls)
    alarms: dict[int, tuple[str, ...]] = {}
    if healthy(answers):
        try:
            alarms = await client.alarms()
        except EtcdAwayError:  # a leader that has just lost the others says for a while that it leads
            answers = await ask_all(members, tls)
    is_led = bool(healthy(answers))
    lines = tuple(_member_line(member, answers[member.id], alarms.get(member.id, ())) for member in members)
    masters = await _ask_masters(members, tls, http_port)
    advised = list(_advice(members, lines, masters)) if is_led else [no_quorum(members, answering(answers))]
    return ClusterReport(members=lines, masters=masters, advice=tuple(advised))


def _member_line(member: Member, answer: object, alarms: tuple[str, ...]) -> MemberLine:
    address = member.client or member.peer
    if not isinstance(answer, MemberStatus):
        role = "learner" if member.is_learner else "away"
        why = str(answer or "was never started")
        return MemberLine(name=member.shown, address=address, role=role, health=why, alarms=alarms)
    role = "learner" if member.is_learner else "leader" if answer.leader == member.id else "follower"
    return MemberLine(
        name=member.shown,
        address=address,
        role=role,
        health="ok" if answer.leader else "knows no leader: it has no quorum",
        version=answer.version,
        size=answer.size,
        alarms=alarms,
    )


async def _ask_masters(members: Sequence[Member], tls: Context | None, port: int) -> tuple[MasterLine, ...]:
    timeout = aiohttp.ClientTimeout(total=ANSWER_S)
    async with aiohttp.ClientSession(timeout=timeout, trust_env=False) as session:
        return tuple(await asyncio.gather(*(_ask_master(session, each, tls, port) for each in members)))


async def _ask_master(
    session: aiohttp.ClientSession, member: Member, tls: Context | None, port: int
) -> MasterLine:
    url = f"{'http' if tls is None else 'https'}://{in_url(member.host)}:{port}/"
    try:
        async with session.get(f"{url}healthz", ssl=True if tls is None else tls()) as reply:
            told: dict[str, Any] = await reply.json()
            role, term = str(told["role"]), int(told["term"])
            lag = told.get("lag")
            return MasterLine(
                name=member.shown,
                url=url,
                role=role,
                status=str(told["status"]),
                term=term,
                lag=None if lag is None else float(lag),
                drained=bool(told.get("drained", False)),
                version=str(told.get("version", "")),
            )
    except (KeyError, TypeError, ValueError):
        why = "is not a master with a store in etcd"
    except TimeoutError:
        why = f"no answer within {ANSWER_S:g} s"
    except (aiohttp.ClientError, OSError) as error:
        why = str(error)
    return MasterLine(name=member.shown, url=url, role="away", status=why)


def _advice(
    members: Sequence[Member], lines: Sequence[MemberLine], masters: Sequence[MasterLine]
) -> Iterable[str]:
    if text := advice(members):
        yield text
    for line in lines:
        if line.role == "away":
            yield (
                f"etcd on {line.name} does not answer; if its machine is lost: rce cluster remove {line.name}"
            )
        if line.role == "learner":
            yield (
                f"{line.name} has no vote yet: run its rce cluster join again, or: rce cluster remove"
                f" {line.name}"
            )
        if "NOSPACE" in line.alarms:
            yield (
                f"the database of {line.name} is full: compact and defragment it, then: etcdctl alarm disarm"
            )
        if "CORRUPT" in line.alarms:
            yield (
                f"the data of {line.name} is damaged: rce cluster remove {line.name}, empty its folder,"
                " join again"
            )
    if not any(one.role == "leader" for one in masters):
        yield "no master leads"
    if len({one.version for one in masters if one.version}) > 1:
        yield "masters have different versions; upgrade the others"


def _table(rows: Sequence[tuple[str, ...]]) -> Iterable[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)]
    for row in rows:
        yield "  ".join([*(cell.ljust(width) for cell, width in zip(row[:-1], widths, strict=True)), row[-1]])
