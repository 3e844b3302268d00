"""Machines as network namespaces, joined by a switch in a namespace of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

KILL_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class NetworkMachine:
    """A machine on the test's network."""

    namespace: str
    address: str
    switch: str
    port: str
    """The switch's interface that this machine is plugged into."""

    @property
    def prefix(self) -> list[str]:
        """What comes before a command line to run it on this machine."""
        return ["ip", "netns", "exec", self.namespace]

    def unplug(self) -> None:
        """Pull the cable, at the machine's own end and the switch's."""
        _ip("-n", self.switch, "link", "set", self.port, "down")

    def plug(self) -> None:
        """Put the cable back."""
        _ip("-n", self.switch, "link", "set", self.port, "up")

    def interface_down(self) -> None:
        """Switch the machine's interface off: its address has no network any longer."""
        _ip("-n", self.namespace, "link", "set", "eth0", "down")

    def interface_up(self) -> None:
        """Switch it on again."""
        _ip("-n", self.namespace, "link", "set", "eth0", "up")

    def add_private_address(self, address: str) -> None:
        """Give the machine an address that others have no way to."""
        _ip("-n", self.namespace, "address", "add", f"{address}/32", "dev", "lo")

    def has_way_to(self, address: str) -> bool:
        """Whether packets for an address would go anywhere."""
        argv = ["ip", "-n", self.namespace, "route", "get", address]
        return subprocess.run(argv, check=False, capture_output=True).returncode == 0


@contextmanager
def network(count: int) -> Iterator[list[NetworkMachine]]:
    """Make machines 10.77.0.1, 10.77.0.2 ... on one network; at the end, remove them and what runs there."""
    tag = f"rce{os.getpid()}"
    switch = f"{tag}-switch"
    machines = [
        NetworkMachine(f"{tag}-{number}", f"10.77.0.{number}", switch, f"port{number}")
        for number in range(1, count + 1)
    ]
    try:
        _ip("netns", "add", switch)
        _ip("-n", switch, "link", "add", "name", "bridge", "type", "bridge", "mcast_snooping", "0")
        _ip("-n", switch, "link", "set", "bridge", "up")
        for machine in machines:
            _plug_in(machine)
        yield machines
    finally:
        for namespace in [*(machine.namespace for machine in machines), switch]:
            _remove(namespace)


def _plug_in(machine: NetworkMachine) -> None:
    inside, switch = machine.namespace, machine.switch
    _ip("netns", "add", inside)
    peer = ("peer", "name", "eth0", "netns", inside)
    _ip("-n", switch, "link", "add", "name", machine.port, "type", "veth", *peer)
    _ip("-n", switch, "link", "set", machine.port, "master", "bridge", "up")
    _ip("-n", inside, "address", "add", f"{machine.address}/24", "dev", "eth0")
    for interface in ("lo", "eth0"):
        _ip("-n", inside, "link", "set", interface, "up")


def _remove(namespace: str) -> None:
    deadline = time.monotonic() + KILL_TIMEOUT_S
    while pids := _pids(namespace):
        for pid in pids:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        if time.monotonic() > deadline:
            break
        time.sleep(0.05)
    subprocess.run(["ip", "netns", "del", namespace], check=False, capture_output=True)


def _pids(namespace: str) -> list[int]:
    found = subprocess.run(
        ["ip", "netns", "pids", namespace], check=False, capture_output=True, text=True
    ).stdout
    return [int(pid) for pid in found.split()]


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
