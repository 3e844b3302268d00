"""The cost of TLS on the robot's connection: round trips to a node with and without it, in turn.

Both robot endpoints are started for it: the engine's own one has grown with the suites before.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import ssl
from collections.abc import AsyncIterator
from time import perf_counter
from typing import Any

import psutil

from benchmarks.engine import BIN, RunningEngine, cpu_seconds, free_ports
from benchmarks.figures import percentile
from benchmarks.roundtrip import Trip, converter_trip, forwarder_trip
from benchmarks.targets import TLS_RATIO
from benchmarks.wire import robot_at, wire_echo
from rce.supervision.process import Child
from rce.tls.folder import CertificateFolder

SIZES = (20, 6951, 61584)
PAIRS = 600
WARM_UP = 50
Figures = dict[tuple[str, int, str], list[float]]
"""Form, bytes and ``plain`` or ``tls`` to seconds."""
_TRIPS = {"Converter": converter_trip, "Forwarder": forwarder_trip}


def make_certificates(running: RunningEngine) -> CertificateFolder:
    """Make an authority, and a certificate of it for an endpoint."""
    certificates = CertificateFolder(running.folder / "bench-certificates")
    certificates.make_authority()
    certificates.issue("endpoint", ("127.0.0.1",))
    return certificates


@contextlib.asynccontextmanager
async def endpoint(
    running: RunningEngine, certificates: CertificateFolder | None = None
) -> AsyncIterator[tuple[str, psutil.Process]]:
    """Run another robot endpoint of the engine, whose robots connect in TLS if it has certificates.

    Yields:
        Its URL and its process.
    """
    (port,) = free_ports(1)
    argv = [str(BIN / "rce-robot"), "127.0.0.1", "--dev", "--control-port", str(running.control_port)]
    argv += ["--ws-port", str(port), "--link-port", "0"]
    if certificates is not None:
        argv += ["--tls-cert", str(certificates.certificate("endpoint"))]
        argv += ["--tls-key", str(certificates.key("endpoint"))]
    env = os.environ | {"XDG_RUNTIME_DIR": str(running.folder)}
    child = await Child.start("rce-robot", argv, env=env)
    try:
        lines = child.lines()
        async for line in lines:
            if "ready:" in line:
                break
        drain = asyncio.create_task(_drain(child))
        yield f"{'ws' if certificates is None else 'wss'}://127.0.0.1:{port}/", psutil.Process(child.pid)
        drain.cancel()
    finally:
        await child.stop()


async def _drain(child: Child) -> None:
    async for _ in child.lines():
        pass


async def run(running: RunningEngine, *, passes: int) -> list[dict[str, Any]]:
    """Measure both, trip by trip in turn, with new containers in each pass."""
    times: Figures = {}
    costs: Figures = {}
    certificates = make_certificates(running)
    trusting = ssl.create_default_context(cafile=certificates.authority)
    async with (
        endpoint(running) as (plain_url, plain_endpoint),
        endpoint(running, certificates) as (url, secured_endpoint),
    ):
        endpoints = {"plain": plain_endpoint, "tls": secured_endpoint}
        for number in range(passes):
            for form, make_trip in _TRIPS.items():
                async with (
                    robot_at(plain_url, f"plain{form}{number}") as plain,
                    robot_at(url, f"tls{form}{number}", trusting) as secured,
                ):
                    for client in (plain, secured):
                        await wire_echo(client, form, f"c{client.name}")
                    trips = {"plain": make_trip(plain), "tls": make_trip(secured)}
                    await _measure(form, trips, times)
                    await _weigh(form, trips, endpoints, costs)
                    for client in (plain, secured):
                        await client.send("DC", {"containerTag": f"c{client.name}"})
    return [_row(form, size, times, costs) for form in _TRIPS for size in SIZES]


async def _measure(form: str, trips: dict[str, Trip], times: Figures) -> None:
    """Measure the time of each trip."""
    for size in SIZES:
        gc.collect()
        for number in range(WARM_UP + PAIRS):
            for name, trip in trips.items():
                start = perf_counter()
                await trip(size)
                if number >= WARM_UP:
                    times.setdefault((form, size, name), []).append(perf_counter() - start)


async def _weigh(
    form: str, trips: dict[str, Trip], endpoints: dict[str, psutil.Process], costs: Figures
) -> None:
    """Measure the processor time of the robot endpoint, more accurate than the clock on a busy machine."""
    for size in SIZES:
        for name, trip in trips.items():
            before = cpu_seconds(endpoints[name])
            for _ in range(PAIRS):
                await trip(size)
            cost = (cpu_seconds(endpoints[name]) - before) / PAIRS
            costs.setdefault((form, size, name), []).append(cost)


def _row(form: str, size: int, times: Figures, costs: Figures) -> dict[str, Any]:
    plain, secured = times[form, size, "plain"], times[form, size, "tls"]
    ratio = percentile(secured, 0.5) / percentile(plain, 0.5)
    target = TLS_RATIO.get(size)
    return {
        "form": form,
        "bytes": size,
        "plain p50_ms": round(1e3 * percentile(plain, 0.5), 4),
        "tls p50_ms": round(1e3 * percentile(secured, 0.5), 4),
        "x plain (p50)": round(ratio, 3),
        "x plain (p10)": round(percentile(secured, 0.1) / percentile(plain, 0.1), 3),
        **{f"{name} cpu_ms": round(1e3 * min(costs[form, size, name]), 4) for name in ("plain", "tls")},
        "target": "" if target is None else f"{target:.2f} {'met' if ratio <= target else 'missed'}",
    }
