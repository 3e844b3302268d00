"""How a machine begins a cluster of etcd, joins one, and how a member is removed."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from typing import TYPE_CHECKING

from rce.dialing import open_socket
from rce_master.cluster.client import ClusterClient, answering, ask_all, healthy
from rce_master.cluster.engines import forget_masters, known_masters
from rce_master.cluster.members import (
    ClusterError,
    Member,
    advice,
    check_new,
    check_removal,
    find,
    no_quorum,
    quorum,
)
from rce_master.store.etcd.exceptions import EtcdAwayError, EtcdError, EtcdRefusedError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.tls import Context
    from rce_master.cluster.files import Machine

START_S = 120.0
"""How long etcd may take until it answers, and a learner until it has the state."""
_REACH_S = 5.0
_PAUSE_S = 0.3
_UNHEALTHY = "unhealthy cluster"


def check_place(machine: Machine) -> None:
    """Check that etcd can be started on this machine for the first time.

    Raises:
        ClusterError: It has data already, the address is not of this machine, or a port is taken.
    """
    try:
        with_data = machine.data.exists() and any(machine.data.iterdir())
    except OSError as error:
        raise ClusterError(f"cannot read {machine.data}: {error}") from error
    if with_data:
        raise ClusterError(
            f"{machine.data} has the data of a member already: this machine is in a cluster. To join"
            " another one"
            f" or to join again after `rce cluster remove`, stop etcd and remove {machine.data}"
        )
    check_ports(machine)


def check_ports(machine: Machine) -> None:
    """Check that etcd can listen on this machine.

    Raises:
        ClusterError: The address is not of this machine, or a port is taken.
    """
    for port, option in ((machine.client_port, "--client-port"), (machine.peer_port, "--peer-port")):
        family = socket.AF_INET6 if ":" in machine.host else socket.AF_INET
        with socket.socket(family) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                sock.bind((machine.host, port))
            except OSError as error:
                why = os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)
                raise ClusterError(
                    f"cannot listen on {machine.host}:{port}: {why}; --address must be one of this"
                    " machine that"
                    f" the others reach, and the port free ({option})"
                ) from error


async def request_membership(client: ClusterClient, machine: Machine, tls: Context | None) -> dict[str, str]:
    """Let a cluster accept a machine, as a member without a vote.

    The others must all work and be within reach. A request that was accepted before is accepted again.

    Returns:
        The URL for other members of each member, by its name.

    Raises:
        ClusterError: The cluster cannot accept it now; it was not changed.
        EtcdError: etcd does not answer, or refused.
    """
    members = await client.members()
    own = next((each for each in members if each.peer == machine.peer and not each.name), None)
    if own is None:
        check_new(members, machine.name, machine.client, machine.peer)
    await _check_all_work(members, own, tls)
    for member in members:
        if member is not own:
            await _check_reach(member)
    if own is None:
        members = await _add_learner(client, machine.peer_url)
    scheme = machine.scheme
    return {each.name or machine.name: f"{scheme}://{each.peer}" for each in members}


async def wait_for_vote(
    endpoints: Sequence[str], machine: Machine, tls: Context | None
) -> tuple[Member, ...]:
    """Wait until this machine's member runs, and give it a vote; return all members.

    Args:
        endpoints: ``HOST:PORT`` of the other members, or of this one if it is the first.
        machine: This machine.
        tls: TLS of requests.

    Raises:
        ClusterError: It did not come up in time, or was removed.
    """
    async with ClusterClient(endpoints, tls=tls) as client:
        why: object = "etcd was not started"
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(START_S):
                while True:
                    try:
                        members = await client.members()
                        own = next((each for each in members if each.peer == machine.peer), None)
                        if own is None:
                            raise ClusterError(
                                f"{machine.name} is not a member any more: it was removed. To join again,"
                                f" stop etcd, remove {machine.data} and {machine.config}, and run this again"
                            )
                        if own.name and not own.is_learner:
                            await client.get("/")
                            return members
                        if own.name:
                            await client.promote(own.id)
                    except EtcdError as error:  # not in sync yet, or no leader yet
                        why = error
                    await asyncio.sleep(_PAUSE_S)
    raise ClusterError(
        f"etcd on this machine is not a member with a vote after {START_S:.0f} s: {why}; look at its"
        " log, then run the"
        " same command again"
    )


async def _add_learner(client: ClusterClient, peer_url: str) -> tuple[Member, ...]:
    """Add a learner; etcd takes none before all members have been connected for some seconds."""
    clock = asyncio.get_running_loop().time
    end = clock() + START_S
    while True:
        try:
            return await client.add_learner(peer_url)
        except EtcdAwayError as error:
            if _UNHEALTHY not in str(error) or clock() >= end:
                raise
        await asyncio.sleep(_PAUSE_S)


async def remove_member(
    client: ClusterClient, name: str, tls: Context | None, *, force: bool
) -> tuple[Member, tuple[Member, ...]]:
    """Remove a member, also one whose machine is lost.

    Args:
        client: A client of all members.
        name: The member's name.
        tls: TLS of requests.
        force: Remove it also if the others have no quorum then.

    Returns:
        The removed member, and the others.

    Raises:
        UnknownMemberError: The member is unknown.
        ClusterError: The cluster would lose its quorum.
        EtcdError: etcd does not answer, or refused.
    """
    members = await client.members()
    leaving = find(members, name)
    answers = await ask_all(members, tls)
    working = healthy(answers)
    if not working:
        raise ClusterError(no_quorum(members, answering(answers)))
    try:
        check_removal(members, working, leaving)
    except ClusterError:
        if not force or len(members) == 1:
            raise
    try:
        await client.remove(leaving.id)
    except (EtcdAwayError, EtcdRefusedError) as error:
        if _UNHEALTHY in str(error):  # of a member that leads, and of others that passed it on
            raise ClusterError(
                "etcd refused: it removes no working member while others do not work, or just after they"
                f" joined; remove those first. ({error})"
            ) from error
        if isinstance(error, EtcdRefusedError):
            raise
        there = answering(await ask_all(members, tls))
        raise ClusterError(f"{no_quorum(members, there)} ({error})") from error
    return leaving, tuple(each for each in members if each.id != leaving.id)


async def forget_machine(client: ClusterClient, name: str, host: str = "") -> list[str]:
    """Remove what etcd knows of the masters of a machine, of all engines that it keeps.

    Args:
        client: A client of all members.
        name: The machine's name.
        host: Its address; empty if it is not known.

    Returns:
        Their names.

    Raises:
        StoreError: etcd does not answer, refused, or a key was overwritten.
    """
    gone = [
        one
        for one in await known_masters(client)
        if (name and one.name.rpartition(":")[0] == name) or (host and one.host == host)
    ]
    await forget_masters(client, gone)
    return [one.shown for one in gone]


async def cluster_client(endpoints: Sequence[str], tls: Context | None) -> ClusterClient:
    """Return a client of all members, once one of some was asked for them; without those that have no vote.

    It asks the member first that answered: each one before it that is silent would take time again.

    Raises:
        EtcdError: None of them answers.
    """
    async with ClusterClient(endpoints, tls=tls, attempt=_REACH_S) as first:
        members = await first.members()
        ordered = dict.fromkeys([first.in_use, *endpoints])
    known = [each.client for each in members if each.client and not each.is_learner]
    found = [*(each for each in ordered if each in known), *(each for each in known if each not in ordered)]
    return ClusterClient(found or list(ordered), tls=tls, attempt=_REACH_S)


def hint(members: Sequence[Member]) -> str:
    """Return the line on how many machines the cluster has."""
    voters = sum(not each.is_learner for each in members)
    losses = voters - quorum(voters)
    survives = f"it survives the loss of {'a machine' if losses == 1 else f'{losses} machines'}"
    return f"{voters} member{'s' * (voters != 1)}; {advice(members) or survives}"


async def _check_all_work(members: Sequence[Member], own: Member | None, tls: Context | None) -> None:
    answers = await ask_all(members, tls)
    working = healthy(answers)
    for member in members:
        if member is own or member.id in working:
            continue
        why = answers[member.id]
        raise ClusterError(
            f"member {member.shown} does not work ({why or 'it was never started'}): start it, or"
            " remove it first:"
            f" rce cluster remove {member.shown}"
        )


async def _check_reach(member: Member) -> None:
    """Check that the port for members can be reached; that for masters has answered."""
    host, _, port = member.peer.rpartition(":")
    try:
        async with asyncio.timeout(_REACH_S):
            connected = await open_socket(host.strip("[]"), int(port))
    except (OSError, TimeoutError) as error:
        raise ClusterError(
            f"{member.shown} cannot be reached from here at {member.peer}, its address for members: {error};"
            " open this port between the machines"
        ) from error
    connected.close()
