"""Faults of the network: cables, firewalls, and slow links."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager

from support.networks import NetworkMachine

from rce.config.store_address import ETCD_PORT

_START_S = 90.0


FROM_ETCD = (
    ("OUTPUT", "-p", "tcp", "--dport", str(ETCD_PORT)),
    ("INPUT", "-p", "tcp", "--sport", str(ETCD_PORT)),
)
"""Rules that cut the master of a machine off from all members of etcd."""


def between(other: NetworkMachine, port: int | None, chains: Sequence[str]) -> list[Sequence[str]]:
    """Return rules that cut a machine off from another one.

    Args:
        other: The other one.
        port: At either end; None: all packets.
        chains: INPUT, OUTPUT, or both of them.
    """
    ports = [("-p", "tcp", end, str(port)) for end in ("--sport", "--dport")] if port else [()]
    side = {"INPUT": "-s", "OUTPUT": "-d"}
    return [(chain, side[chain], other.address, *each) for chain in chains for each in ports]


@contextmanager
def unplugged(place: NetworkMachine) -> Iterator[None]:
    """Pull a machine's cable."""
    place.unplug()
    try:
        yield
    finally:
        place.plug()


@contextmanager
def dropped(places: Sequence[NetworkMachine], *rules: Sequence[str]) -> Iterator[None]:
    """Let machines drop packets; a rule is a chain and conditions of iptables.

    Example:
        ```python
        with dropped([place], ("INPUT", "-p", "tcp", "--dport", "8080")):
            ...
        ```
    """
    orders = [(place, rule) for place in places for rule in rules]
    made = []
    try:
        for place, rule in orders:
            _iptables(place, "-A", rule)
            made.append((place, rule))
        yield
    finally:
        for place, rule in made:
            _iptables(place, "-D", rule)


def _iptables(place: NetworkMachine, action: str, rule: Sequence[str]) -> None:
    argv = [*place.prefix, "iptables", "-w", action, *rule, "-j", "DROP"]
    subprocess.run(argv, check=True, capture_output=True)


@asynccontextmanager
async def slow(
    place: NetworkMachine, seed: int, *, delay: float, loss: float, tag: str = ""
) -> AsyncIterator[None]:
    """Put a cable in place that delays and loses frames, in both directions.

    Args:
        place: The machine.
        seed: Of the losses.
        delay: Seconds.
        loss: Share of frames, 0 to 1.
        tag: Tells several of them apart.
    """
    near, far = f"n{os.getpid()}{tag}", f"f{os.getpid()}{tag}"
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rce_fleet.experiments.link_emulator", near, far),
        *("--delay", repr(delay), "--loss", repr(loss), "--seed", str(seed)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(_START_S):
            assert await process.stdout.readline() == b"ready\n", "the link emulator did not start"
        _ip("link", "set", near, "netns", place.namespace)
        _ip("link", "set", far, "netns", place.switch)
        _ip("-n", place.switch, "link", "set", far, "master", "bridge", "up")
        place.unplug()
        # Its address moves to the other interface; connections stay.
        _ip("-n", place.namespace, "address", "del", f"{place.address}/24", "dev", "eth0")
        _ip("-n", place.namespace, "address", "add", f"{place.address}/24", "dev", near)
        _ip("-n", place.namespace, "link", "set", near, "up")
        yield
    finally:
        process.terminate()
        await process.communicate()  # its interfaces go with it, and their address
        show = ["ip", "-n", place.namespace, "address", "show", "dev", "eth0"]
        present = subprocess.run(show, capture_output=True, text=True, check=True).stdout
        if place.address not in present:
            _ip("-n", place.namespace, "address", "add", f"{place.address}/24", "dev", "eth0")
        place.plug()


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
