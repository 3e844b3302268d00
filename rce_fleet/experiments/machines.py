"""Machines as network namespaces on one switch, with links shaped like a wireless LAN.

Each machine has an interface ``wlan0`` with its address. The kernel's ``tbf`` limits the rate in each
direction; a :mod:`~rce_fleet.experiments.link_emulator` delays and loses frames, where the shape asks for it.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
import shutil
import sys
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Self

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.delay_line import LinkShape
from rce_fleet.experiments.ownership import new_tag

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

INTERFACE = "wlan0"
SUBNET = "10.89.0"
"""First three numbers of the machines' addresses; only their namespaces have them."""
QUEUE_S = 0.05
"""Longest time that a packet waits for its turn at a limited rate; others are lost."""
MIN_BURST_BYTES = 3200
"""Two Ethernet frames: with less, ``tbf`` passes none."""
BURST_S = 0.004
"""The longest burst at full speed, seconds at the limited rate: the kernel's clock ticks that often."""
START_S = 60.0
"""Seconds for a program on a machine to start or to answer, also on a busy computer."""
TOOLS = ("ip", "tc", "setpriv")
"""Programs by which machines and the programs on them are made."""
_ENDED_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL")
"""Words before a command that end it if this process is killed."""
TUN = Path("/dev/net/tun")
"""The device by which links are emulated."""


@dataclass(frozen=True, slots=True)
class MachineLink:
    """A machine's link to the switch.

    Attributes:
        rate: Bits per second in each direction; 0: not limited.
        shape: Delay, jitter and loss in each direction.
    """

    rate: float = 0.0
    shape: LinkShape = field(default_factory=LinkShape)


@dataclass(frozen=True, slots=True)
class Machine:
    """A machine.

    Attributes:
        name: Its name in the network.
        address: Its IP address.
        namespace: Name of its network namespace.
    """

    name: str
    address: str
    namespace: str

    @property
    def prefix(self) -> tuple[str, ...]:
        """Words before a command that run it on this machine."""
        return ("ip", "netns", "exec", self.namespace)


@dataclass(frozen=True, slots=True)
class Traffic:
    """What a machine's interface has sent and received since it was made, its own headers included."""

    sent_bytes: int
    received_bytes: int
    sent_packets: int
    received_packets: int


@dataclass(frozen=True, slots=True)
class LinkFigures:
    """What was measured of the way between two machines, see :mod:`rce_fleet.experiments.link_probe`.

    Attributes:
        round_trip_s: Median, seconds.
        round_trip_p99_s: 99th percentile, seconds.
        lost: Share of the probes without an answer.
        rate: Bits per second of a TCP stream's payload.
        rate_back: The same of a stream back.
    """

    round_trip_s: float
    round_trip_p99_s: float
    lost: float
    rate: float
    rate_back: float


async def check_machines() -> None:
    """Make sure that machines can be made on this computer.

    Raises:
        ExperimentError: They cannot; the text says what is missing.
    """
    _check_needs()
    name = f"{new_tag()}-check"
    try:
        await _ip("netns", "add", name)
    except ExperimentError as error:
        raise ExperimentError(
            "machines are network namespaces: making them needs the capabilities CAP_SYS_ADMIN and "
            f"CAP_NET_ADMIN, which root in a container may not have: {error}"
        ) from error
    finally:
        await _delete_namespace(name)


def _check_needs() -> None:
    missing = [f"the program {tool}" for tool in TOOLS if shutil.which(tool) is None]
    if os.geteuid() != 0:
        missing.append("to be root")
    if not TUN.exists():
        missing.append(f"the device {TUN}")
    if missing:
        raise ExperimentError(f"machines are network namespaces: making them needs {', '.join(missing)}")


class MachineNetwork:
    """Machines on one switch, while the ``async with`` block runs.

    Args:
        links: The machines' links, by name.
        seed: Of jitter and loss.
        tag: What the names of namespaces and interfaces begin with; at most 12 characters; if empty, one that
            nothing else has.
    """

    def __init__(self, links: Mapping[str, MachineLink], *, seed: int = 0, tag: str = "") -> None:
        self._links = dict(links)
        self._seed = seed
        self._tag = tag or f"rcx{secrets.token_hex(2)}"
        self._stack = AsyncExitStack()
        self._emulators: dict[str, asyncio.subprocess.Process] = {}
        self._sides: dict[str, tuple[tuple[str, str], ...]] = {}
        """Both ends of each machine's link: namespace and interface."""
        self.machines: dict[str, Machine] = {}

    async def __aenter__(self) -> Self:
        """Make the machines.

        Raises:
            ExperimentError: They cannot be made; the text says what is missing.
        """
        _check_needs()
        async with AsyncExitStack() as stack:
            switch = await self._namespace(stack, "switch")
            await _ip("-n", switch, "link", "add", "bridge", "type", "bridge", "mcast_snooping", "0")
            await _ip("-n", switch, "link", "set", "bridge", "up")
            for number, name in enumerate(self._links, start=1):
                self.machines[name] = await self._machine(stack, name, number, switch)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the machines; programs on them must have ended."""
        await self._stack.aclose()

    async def traffic(self, name: str) -> Traffic:
        """Return what a machine has sent and received."""
        namespace = self.machines[name].namespace
        shown = json.loads(await _ip("-n", namespace, "-s", "-j", "link", "show", "dev", INTERFACE))
        counted = shown[0]["stats64"]
        return Traffic(
            *(counted[side]["bytes"] for side in ("tx", "rx")),
            *(counted[side]["packets"] for side in ("tx", "rx")),
        )

    async def reshape(self, name: str, shape: LinkShape) -> None:
        """Give a machine's emulated link another shape.

        Raises:
            ExperimentError: The link is not emulated, or its emulator has ended.
        """
        await self._order(name, json.dumps(asdict(shape)))

    async def set_rate(self, name: str, rate: float) -> None:
        """Give a machine's link another rate, bits per second in each direction.

        Raises:
            ExperimentError: The link has no rate so far.
        """
        if not self._links[name].rate:
            raise ExperimentError(f"the link of {name} was made without a rate, so it cannot get one")
        for place, interface in self._sides[name]:
            await _run("tc", "-n", place, "qdisc", "change", "dev", interface, "root", *_limit(rate))

    async def emulation_s(self) -> float:
        """Return the processor time that the emulators of all links took so far, seconds.

        Raises:
            ExperimentError: One has ended.
        """
        answers = [await self._order(name, "{}") for name in self._emulators]
        return float(sum(json.loads(answer)["cpu_s"] for answer in answers))

    async def _order(self, name: str, order: str) -> bytes:
        emulator = self._emulators.get(name)
        if emulator is None:
            raise ExperimentError(f"the link of {name} has no delay, jitter or loss, so it is not emulated")
        assert emulator.stdin is not None
        assert emulator.stdout is not None
        try:
            emulator.stdin.write(f"{order}\n".encode())
            async with asyncio.timeout(START_S):
                answer = await emulator.stdout.readline()
        except TimeoutError as error:
            raise ExperimentError(
                f"the emulator of {name}'s link does not answer within {START_S:g} s"
            ) from error
        except OSError as error:
            raise ExperimentError(f"the emulator of {name}'s link does not answer: {error}") from error
        if not answer:
            raise ExperimentError(f"the emulator of {name}'s link has ended")
        return answer

    async def probe(self, name: str, other: str) -> LinkFigures:
        """Measure the way from one machine to another and back.

        Raises:
            ExperimentError: The other one is not reached.
        """
        command = (sys.executable, "-m", "rce_fleet.experiments.link_probe")
        target = self.machines[other]
        server = await asyncio.create_subprocess_exec(
            *(*target.prefix, *_ENDED_WITH_PARENT, *command, "serve", target.address),
            stdout=asyncio.subprocess.PIPE,
        )
        try:
            assert server.stdout is not None
            try:
                async with asyncio.timeout(START_S):
                    await server.stdout.readline()
            except TimeoutError as error:
                raise ExperimentError(
                    f"the link of {name} cannot be measured: the program on {other} did not start within"
                    f" {START_S:g} s"
                ) from error
            asking = (*self.machines[name].prefix, *_ENDED_WITH_PARENT, *command)
            shown = await _run(*asking, "measure", target.address)
        finally:
            await _end(server)
        return LinkFigures(**json.loads(shown))

    async def _namespace(self, stack: AsyncExitStack, name: str) -> str:
        namespace = f"{self._tag}-{name}"
        # Registered first: a cancellation may come while the namespace is made.
        stack.push_async_callback(_delete_namespace, namespace)
        await _ip("netns", "add", namespace)
        await _ip("-n", namespace, "link", "set", "lo", "up")
        return namespace

    async def _machine(self, stack: AsyncExitStack, name: str, number: int, switch: str) -> Machine:
        link = self._links[name]
        namespace = await self._namespace(stack, name)
        near, far = f"{self._tag}n{number}", f"{self._tag}f{number}"
        if link.shape == LinkShape():
            stack.push_async_callback(_delete_link, near)
            await _ip("link", "add", near, "type", "veth", "peer", "name", far)
        else:
            await self._emulate(stack, name, near, far, link.shape, number)
        await _ip("link", "set", near, "netns", namespace, "name", INTERFACE)
        await _ip("link", "set", far, "netns", switch)
        address = f"{SUBNET}.{number}"
        await _ip("-n", namespace, "address", "add", f"{address}/24", "dev", INTERFACE)
        await _ip("-n", namespace, "link", "set", INTERFACE, "up")
        await _ip("-n", namespace, "route", "add", "224.0.0.0/4", "dev", INTERFACE)
        await _ip("-n", switch, "link", "set", far, "master", "bridge", "up")
        self._sides[name] = ((namespace, INTERFACE), (switch, far))
        if link.rate:
            for place, interface in self._sides[name]:
                await _run("tc", "-n", place, "qdisc", "add", "dev", interface, "root", *_limit(link.rate))
        return Machine(name, address, namespace)

    async def _emulate(
        self, stack: AsyncExitStack, name: str, near: str, far: str, shape: LinkShape, number: int
    ) -> None:
        values = {"--delay": shape.delay, "--jitter": shape.jitter, "--loss": shape.loss}
        options = [word for option, value in values.items() for word in (option, repr(value))]
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rce_fleet.experiments.link_emulator", near, far, *options),
            *("--seed", str(self._seed + 2 * number)),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )
        stack.push_async_callback(_end, process)
        assert process.stdout is not None
        try:
            async with asyncio.timeout(START_S):
                line = await process.stdout.readline()
        except TimeoutError:
            line = b""
        if line != b"ready\n":
            raise ExperimentError(f"the link of {name} cannot be emulated: its program did not start")
        self._emulators[name] = process


def _limit(rate: float) -> list[str]:
    burst = max(MIN_BURST_BYTES, int(rate / 8 * BURST_S))
    return ["tbf", "rate", f"{int(rate)}bit", "burst", str(burst), "latency", f"{1e3 * QUEUE_S:g}ms"]


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.terminate()
    await process.communicate()


async def _delete_namespace(name: str) -> None:
    if _is_there("/run/netns", name):
        await _ip("netns", "del", name)


async def _delete_link(name: str) -> None:
    """Delete an interface that was not moved to its machine yet."""
    if _is_there("/sys/class/net", name):
        await _ip("link", "del", name)


def _is_there(folder: str, name: str) -> bool:
    return Path(folder, name).exists()


async def _ip(*words: str) -> str:
    return await _run("ip", *words)


async def _run(*argv: str) -> str:
    process = await asyncio.create_subprocess_exec(
        *argv, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    try:
        out, error = await process.communicate()
    except asyncio.CancelledError:
        await process.wait()  # what it makes is removed afterwards
        raise
    if process.returncode:
        raise ExperimentError(f"{' '.join(argv)}: {error.decode(errors='replace').strip()}")
    return out.decode()
