"""The members of an etcd cluster, and which changes of them are safe. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from rce_master.exceptions import MasterError
from rce_master.store.etcd.wire import WireError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from rce_master.store.etcd.wire import Message

WANTED = 3
"""The fewest members that survive the loss of one."""


class ClusterError(MasterError):
    """A change of the cluster was refused, or failed; the text says what to do."""


class UnknownMemberError(ClusterError):
    """The cluster has no member of that name."""


@dataclass(frozen=True, slots=True)
class Member:
    """A member of etcd, as the cluster knows it."""

    id: int
    name: str
    """Empty until it has been started for the first time."""
    peer: str
    """``HOST:PORT`` by which other members reach it."""
    client: str
    """``HOST:PORT`` by which masters reach it; empty until it has been started."""
    is_learner: bool = False
    """It receives the state, and has no vote yet."""

    @property
    def shown(self) -> str:
        """What to call it in messages."""
        return self.name or f"{self.id:x}"

    @property
    def host(self) -> str:
        """The machine."""
        return (self.client or self.peer).rpartition(":")[0].strip("[]")


@dataclass(frozen=True, slots=True)
class MemberStatus:
    """What one member tells of itself."""

    id: int
    version: str
    size: int
    """Of its database, bytes."""
    leader: int
    """The member that leads; 0: it knows none."""
    term: int
    """etcd's own term, which is not that of the masters."""
    index: int
    """How far it has got in the log."""


def read_members(answer: Message) -> tuple[Member, ...]:
    """Read the answer to a request for the members, or to a change of them.

    Raises:
        WireError: It is not one.
    """
    try:
        return tuple(
            Member(
                int(each["ID"]),
                str(each.get("name", "")),
                _address(each["peerURLs"]),
                _address(each.get("clientURLs", ())),
                bool(each.get("isLearner", False)),
            )
            for each in answer["members"]
        )
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise WireError(f"not a list of members: {error!r}") from error


def read_status(answer: Message) -> MemberStatus:
    """Read what a member tells of itself.

    Raises:
        WireError: It does not.
    """
    try:
        return MemberStatus(
            int(answer["header"]["member_id"]),
            str(answer["version"]),
            int(answer.get("dbSize", 0)),
            int(answer.get("leader", 0)),
            int(answer.get("raftTerm", 0)),
            int(answer.get("raftIndex", 0)),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise WireError(f"not the status of a member: {error!r}") from error


def read_alarms(answer: Message) -> dict[int, tuple[str, ...]]:
    """Read the alarms of each member, by its number.

    Raises:
        WireError: It is not a list of alarms.
    """
    try:
        found: dict[int, tuple[str, ...]] = {}
        for each in answer.get("alarms", []):
            member = int(each["memberID"])
            found[member] = (*found.get(member, ()), str(each.get("alarm", "NONE")))
    except (KeyError, ValueError, TypeError) as error:
        raise WireError(f"not a list of alarms: {error!r}") from error
    return found


def find(members: Sequence[Member], name: str) -> Member:
    """Return the member of a name, or of a number in hexadecimal digits.

    Raises:
        UnknownMemberError: There is none.
    """
    for member in members:
        if name in (member.name, f"{member.id:x}"):
            return member
    known = ", ".join(member.shown for member in members)
    raise UnknownMemberError(f"no member is named {name!r}; members: {known}")


def check_new(members: Sequence[Member], name: str, client: str, peer: str) -> None:
    """Check that a machine may join.

    Raises:
        ClusterError: Its name or an address of it belongs to a member.
    """
    for member in members:
        if member.name == name:
            raise ClusterError(
                f"a member is named {name} already, at {member.client or member.peer}; choose another --name,"
                f" or if that machine is lost: rce cluster remove {name}"
            )
        if member.peer == peer or (client and member.client == client):
            raise ClusterError(
                f"member {member.shown} has the address {peer} already; if it is lost, remove it first:"
                f" rce cluster remove {member.shown}"
            )


def check_removal(members: Sequence[Member], healthy: Collection[int], leaving: Member) -> None:
    """Check that the others have a quorum once a member has left.

    Args:
        members: All members.
        healthy: The numbers of those that answer.
        leaving: The member to remove.

    Raises:
        ClusterError: They have none; etcd would stop.
    """
    others = [member for member in members if member.id != leaving.id and not member.is_learner]
    if not others:
        raise ClusterError(
            f"{leaving.shown} is the last member: the state would be lost. To give it up, stop etcd"
            " and remove"
            " its folder"
        )
    if leaving.is_learner:
        return
    needed = quorum(len(others))
    working = [member for member in others if member.id in healthy]
    if len(working) < needed:
        away = ", ".join(member.shown for member in others if member.id not in healthy)
        raise ClusterError(
            f"without {leaving.shown}, {needed} of {len(others)} members must work, and {len(working)} would:"
            f" {away} does not answer. Start it or remove it first; --force removes {leaving.shown}"
            " nevertheless"
        )


def no_quorum(members: Sequence[Member], answering: Collection[int]) -> str:
    """Return that etcd can change nothing, which members answer, and what to do.

    Args:
        members: All members.
        answering: The numbers of those that answer.
    """
    there = ", ".join(each.shown for each in members if each.id in answering) or "no member"
    away = ", ".join(each.shown for each in members if each.id not in answering) or "none"
    return (
        f"etcd has no quorum, so that nothing can be written or removed. Answering: {there}; away: {away}."
        " Start members until more than half work; if they are lost for good, on a machine that is left:"
        " rce cluster recover"
    )


def quorum(voters: int) -> int:
    """Return how many members must work."""
    return voters // 2 + 1


def advice(members: Sequence[Member]) -> str:
    """Return what the number of members lacks; empty if nothing."""
    count = sum(not member.is_learner for member in members)
    if count == 1:
        return "one machine survives no failure; join two more"
    if count < WANTED:
        return (
            "two machines cannot be highly available: if one fails, the other is not more than half; join a"
            " third"
        )
    if count % 2 == 0:
        return f"{count} members survive no more failures than {count - 1}; join one more, or remove one"
    return ""


def _address(urls: Any) -> str:
    return urlsplit(urls[0]).netloc if urls else ""
