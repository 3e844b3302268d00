"""A client of etcd that can change the members of a cluster."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rce_master.cluster.members import Member, MemberStatus, read_alarms, read_members, read_status
from rce_master.exceptions import StoreError
from rce_master.store.etcd.client import EtcdClient
from rce_master.store.etcd.wire import as_it_is

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rce.tls import Context

CHANGE_S = 10.0
"""How long a change of the members may take."""
LIST_S = 3.0
"""How long one member may take to tell of all members, which it does without the others."""
ANSWER_S = 2.0
"""How long one member may take to tell of itself."""


class ClusterClient(EtcdClient):
    """Speaks with the members of a cluster about the cluster. An async context manager.

    A change that fails with :class:`EtcdAwayError` may have been made; ask for the members to find out.

    Example:
        ```python
        async with ClusterClient(["10.0.0.1:2379"]) as cluster:
            print([member.name for member in await cluster.members()])
        ```
    """

    async def members(self) -> tuple[Member, ...]:
        """Return all members.

        Raises:
            EtcdError: No member answers, or etcd refused.
        """
        return await self._call("v3/cluster/member/list", {}, read_members, LIST_S)

    async def add_learner(self, peer_url: str) -> tuple[Member, ...]:
        """Add a member that has no vote until it is promoted; return all members.

        Raises:
            EtcdError: No member answers, or etcd refused.
        """
        message = {"peerURLs": [peer_url], "isLearner": True}
        return await self._call("v3/cluster/member/add", message, read_members, CHANGE_S)

    async def promote(self, member: int) -> None:
        """Give a learner a vote.

        Raises:
            EtcdError: No member answers, or etcd refused: it has not received the whole state yet.
        """
        await self._call("v3/cluster/member/promote", {"ID": str(member)}, as_it_is, CHANGE_S)

    async def remove(self, member: int) -> None:
        """Remove a member.

        Raises:
            EtcdError: No member answers, or etcd refused.
        """
        await self._call("v3/cluster/member/remove", {"ID": str(member)}, as_it_is, CHANGE_S)

    async def alarms(self) -> dict[int, tuple[str, ...]]:
        """Return the alarms of each member that has one.

        Raises:
            EtcdError: No member answers, or etcd refused.
        """
        message = {"action": "GET"}
        return await self._call("v3/maintenance/alarm", message, read_alarms)

    async def status(self) -> MemberStatus:
        """Return what the member that answers tells of itself.

        Raises:
            EtcdError: It does not answer.
        """
        return await self._call("v3/maintenance/status", {}, read_status)


async def ask_all(
    members: Sequence[Member], tls: Context | None
) -> dict[int, MemberStatus | StoreError | None]:
    """Return what each member tells of itself, by its number.

    Returns:
        An error if it does not answer; None if it was never started.
    """
    answers = await asyncio.gather(*(_ask(member, tls) for member in members))
    return {member.id: answer for member, answer in zip(members, answers, strict=True)}


def answering(answers: Mapping[int, MemberStatus | StoreError | None]) -> set[int]:
    """Return the members that answer, also those that know no leader."""
    return {number for number, answer in answers.items() if isinstance(answer, MemberStatus)}


def healthy(answers: Mapping[int, MemberStatus | StoreError | None]) -> set[int]:
    """Return the members that answer and know a leader."""
    return {
        number for number, answer in answers.items() if isinstance(answer, MemberStatus) and answer.leader
    }


async def _ask(member: Member, tls: Context | None) -> MemberStatus | StoreError | None:
    if not member.client:
        return None
    async with ClusterClient([member.client], tls=tls, attempt=ANSWER_S) as client:
        try:
            return await client.status()
        except StoreError as error:
            return error
