"""Measure links between two processes: ``python -m benchmarks.link [--way unix|tcp] [--profile]``.

Round trips of one message at a time, the rate of small messages, and service calls, beside a bare echo over
the same kind of socket, all under uvloop.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import cProfile
import multiprocessing
import pstats
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter
from typing import cast

import uvloop

from rce.control.model import ConnectionSpec, EndpointKind, EndpointSpec, LinkAddress, LinkSpec
from rce.link import Endpoint, Interface, LinkHub, Port
from rce.model.names import EndpointId
from rce.model.specs import InterfaceSpec

SIZES = (100, 1_000, 10_000, 100_000, 1_000_000, 10_000_000)
ENDS = (
    ("SubscriberConverter", "PublisherInterface"),
    ("PublisherConverter", "SubscriberInterface"),
    ("ServiceProviderConverter", "ServiceClientInterface"),
)


class Echo(Interface):
    """The far end: sends messages from i1 back on i2."""

    out: Port

    async def start(self) -> None:
        """Be ready."""
        if self.port.spec.tag == "i2":
            Echo.out = self.port

    async def close(self) -> None:
        """Hold nothing."""

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Send a message back."""
        self.out.send(payload, latched=latched)

    async def serve(self, payload: bytes) -> bytes:
        """Answer a request with itself."""
        return payload


class Near(Interface):
    """The measuring end."""

    def __init__(self, port: Port) -> None:
        super().__init__(port)
        self.waiting = 0
        self.arrived: asyncio.Future[None] | None = None

    async def start(self) -> None:
        """Be ready."""

    async def close(self) -> None:
        """Hold nothing."""

    def receive(self, payload: bytes, *, latched: bool) -> None:  # noqa: ARG002
        """Count a message."""
        self.waiting -= 1
        if self.waiting <= 0 and self.arrived is not None and not self.arrived.done():
            self.arrived.set_result(None)


def spec(side: int, address: LinkAddress) -> EndpointSpec:
    """Return one side of the link; side 0 dials."""
    numbers = range(1, len(ENDS) + 1)
    return EndpointSpec(
        id=f"user/e{side}",
        kind=EndpointKind.ROBOT,
        revision=1,
        interfaces=tuple(
            InterfaceSpec(tag=f"i{n}", type=ends[side], message_type="a/B") for n, ends in enumerate(ENDS, 1)
        ),
        links=(LinkSpec(id="L", peer=f"user/e{1 - side}", token="t", dial=side == 0, address=address),),
        connections=tuple(
            ConnectionSpec(id=n, link="L", interface=f"i{n}", peer_interface=f"i{n}") for n in numbers
        ),
    )


class BareEcho(asyncio.Protocol):
    """A bare echo: the cost of the socket and the loop without the engine."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        self.transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        """Send it back."""
        self.transport.write(data)


async def serve_far_end(folder: Path, ready: Connection) -> None:
    """Run the far end until killed; report the TCP ports of the link and of the bare echo."""
    loop = asyncio.get_running_loop()
    hub = LinkHub("here")
    await hub.listen_unix(folder / "link")
    port = await hub.listen_tcp("127.0.0.1", 0)
    unix = await loop.create_unix_server(BareEcho, str(folder / "bare"))
    tcp = await loop.create_server(BareEcho, "127.0.0.1", 0)
    endpoint = Endpoint(EndpointId("user", "e1"), Echo, hub, on_change=lambda: None, on_fault=print)
    await endpoint.apply(spec(1, LinkAddress()))
    ready.send((port, tcp.sockets[0].getsockname()[1]))
    async with unix, tcp:
        await tcp.serve_forever()


def far_end(folder: Path, ready: Connection) -> None:
    """Run the far end's process."""
    uvloop.run(serve_far_end(folder, ready))


@contextlib.asynccontextmanager
async def near_end(address: LinkAddress) -> AsyncIterator[dict[str, Near]]:
    """Connect to the far end."""
    made: dict[str, Near] = {}
    changed = asyncio.Event()

    def make(port: Port) -> Near:
        made[port.spec.tag] = near = Near(port)
        return near

    hub = LinkHub("here")
    endpoint = Endpoint(EndpointId("user", "e0"), make, hub, on_change=changed.set, on_fault=print)
    await endpoint.apply(spec(0, address))
    while len(endpoint.connections) < len(ENDS):
        changed.clear()
        await changed.wait()
    yield made
    await endpoint.close()
    await hub.close()


async def bare_trip(address: LinkAddress) -> Callable[[bytes], Awaitable[None]]:
    """A round trip over a bare socket with asyncio streams' raw parts."""
    if address.unix:
        reader, writer = await asyncio.open_unix_connection(address.unix)
    else:
        reader, writer = await asyncio.open_connection(address.host, address.port)

    async def trip(payload: bytes) -> None:
        writer.write(payload)
        await reader.readexactly(len(payload))

    return trip


async def measure(trip: Callable[[bytes], Awaitable[None]], size: int) -> str:
    """Median and 99th percentile of round trips, in microseconds."""
    payload = bytes(size)
    times = []
    for _ in range(max(20, min(3000, 200_000_000 // size))):
        start = perf_counter()
        await trip(payload)
        times.append(perf_counter() - start)
    return f"{median(times) * 1e6:9.1f} {quantiles(times, n=100)[98] * 1e6:9.1f}"


async def rate(near: dict[str, Near], size: int, in_flight: int, count: int) -> float:
    """Round trips per second with ``in_flight`` at a time."""
    payload, loop = bytes(size), asyncio.get_running_loop()
    start = perf_counter()
    for _ in range(count // in_flight):
        near["i2"].waiting = in_flight
        near["i2"].arrived = loop.create_future()
        for _ in range(in_flight):
            near["i1"].port.send(payload)
        await near["i2"].arrived
    return count / (perf_counter() - start)


async def run(link: LinkAddress, echo: LinkAddress, *, profile: bool) -> None:
    """Measure and print."""
    loop = asyncio.get_running_loop()
    bare = await bare_trip(echo)
    async with near_end(link) as near:

        async def topic(payload: bytes) -> None:
            near["i2"].waiting = 1
            near["i2"].arrived = loop.create_future()
            near["i1"].port.send(payload)
            await near["i2"].arrived

        async def call(payload: bytes) -> None:
            await near["i3"].port.call(payload)

        print(f"round trip, microseconds\n{'bytes':>9} {'p50':>19} {'p99':>9}")
        for size in SIZES:
            for name, trip in (("bare", bare), ("topic", topic), ("service", call)):
                print(f"{size:9} {name:>9} {await measure(trip, size)}")
        for in_flight in (1, 32):
            trips = await rate(near, 64, in_flight, 64_000)
            print(f"64 bytes, {in_flight} in flight: {trips:.0f} round trips/s")
        if profile:
            with cProfile.Profile() as profiler:
                await rate(near, 64, 32, 64_000)
            pstats.Stats(profiler).sort_stats("tottime").print_stats(18)


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.link", description=__doc__)
    parser.add_argument("--way", choices=("unix", "tcp"), default="unix")
    parser.add_argument("--profile", action="store_true", help="show where the time of small messages goes")
    options = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="rcelink", dir="/tmp") as name:
        folder = Path(name)
        ours, theirs = multiprocessing.Pipe()
        process = spawn.Process(target=far_end, args=(folder, theirs))
        process.start()
        try:
            ports = ours.recv()
            if options.way == "unix":
                link, echo = (LinkAddress(machine="here", unix=str(folder / n)) for n in ("link", "bare"))
            else:
                link, echo = (LinkAddress(host="127.0.0.1", port=port) for port in ports)
            uvloop.run(run(link, echo, profile=options.profile))
        finally:
            process.terminate()
            process.join()


if __name__ == "__main__":
    main()
