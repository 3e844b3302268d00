"""``GET /metrics``: metrics for Prometheus, from the state at the time of the request."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

from aiohttp import web
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    GCCollector,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from rce.control import EndpointUsage, InterfaceUsage, NodeUsage
from rce_master.http import metrics_pieces
from rce_master.http.engine_metrics import EngineMetrics
from rce_master.http.metrics_pieces import in_pieces, write_pieces
from rce_master.http.role_metrics import RoleCollector
from rce_master.state.records import Container, Endpoint

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

    from prometheus_client.metrics_core import Metric

    from rce_master.leadership import Fence
    from rce_master.state.placement import Room
    from rce_master.state.tables import Tables
    from rce_master.usage import UsageBook

_NO_USAGE = EndpointUsage()

MAX_SERIES = 50_000
"""Series of containers, nodes and interfaces in one answer; further ones are counted, not listed."""


def make_answer(
    tables: Tables, book: UsageBook, password_checks: Callable[[], int], fence: Fence | None = None
) -> Callable[[], Awaitable[web.Response]]:
    """Return the function that answers a scrape.

    Args:
        tables: The state's tables.
        book: What task sets told of consumption.
        password_checks: Returns how many passwords were checked.
        fence: Of this master's leadership, if there may be other masters.
    """
    registry = make_registry(password_checks)
    if fence is not None:
        registry.register(RoleCollector(lambda: fence.term, leads=True))
    sources = (EngineMetrics(tables, book.newest), Consumption(tables, book))
    headers = {"Content-Type": CONTENT_TYPE_LATEST}

    async def answer() -> web.Response:
        parts = [generate_latest(registry)]
        for source in sources:
            async for part in source.parts():
                parts.append(part)
                await asyncio.sleep(0)
        return web.Response(body=b"".join(parts), headers=headers)

    return answer


def make_registry(password_checks: Callable[[], int]) -> CollectorRegistry:
    """Make a separate registry; the library's global one belongs to the embedding program.

    What grows with the engine is not in it: a registry is written in one step.
    """
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    PlatformCollector(registry=registry)
    GCCollector(registry=registry)
    registry.register(_LoginCollector(password_checks))
    return registry


class _LoginCollector(Collector):
    """Metrics of the cost of logins."""

    def __init__(self, password_checks: Callable[[], int]) -> None:
        self._password_checks = password_checks

    def collect(self) -> Iterator[Metric]:
        """Make all metrics."""
        text = "Unknown passwords that were hashed to check them."
        yield CounterMetricFamily("rce_password_checks", text, value=self._password_checks())


class Consumption:
    """Metrics of the traffic of interfaces, the usage of containers and nodes, and the promises of machines.

    There are many: they are made and written in pieces, and other tasks run in between.

    The labels are only names in the present desired state, so that reports of task sets cannot add labels,
    and a counter ends with the object that it counts.
    """

    def __init__(self, tables: Tables, book: UsageBook) -> None:
        self._tables = tables
        self._book = book

    async def parts(self) -> AsyncIterator[bytes]:
        """Write all metrics, in parts of at most :data:`~rce_master.http.metrics_pieces.PIECE` series."""
        families = _Families(MAX_SERIES)
        made = 0
        async for endpoint in in_pieces(self._tables.endpoints):
            if families.count - made >= metrics_pieces.PIECE:
                made = families.count
                await asyncio.sleep(0)
            usage = self._usage_of(endpoint)
            if isinstance(endpoint, Container):
                self._container(families, endpoint, usage)
            for interface in self._tables.interfaces.by("endpoint", endpoint.id):
                tag = interface.spec.tag
                _interface(families, endpoint.id, tag, usage.interfaces.get(tag))
        for room in self._tables.rooms:
            _machine(families, room)
        omitted = GaugeMetricFamily(
            "rce_metrics_omitted", "Series that found no room in this answer.", value=families.omitted
        )
        for metric in (*families, omitted):
            for piece in write_pieces(metric):
                yield piece

    def _usage_of(self, endpoint: Endpoint) -> EndpointUsage:
        told = self._book.newest.get(endpoint.task_set)
        return told.endpoints.get(endpoint.id, _NO_USAGE) if told else _NO_USAGE

    def _container(self, families: _Families, container: Container, usage: EndpointUsage) -> None:
        for metric in _CONTAINER:
            metric.add(families, {"container": container.id}, usage)
        for way, count in (("read", usage.io_read), ("written", usage.io_written)):
            labels = {"container": container.id, "direction": way}
            families.counter("rce_container_io_bytes", "Bytes from and to disks.", labels, count)
        for way, count in (("in", usage.link_in), ("out", usage.link_out)):
            labels = {"container": container.id, "direction": way}
            families.counter("rce_container_link_bytes", "Bytes on its links.", labels, count)
        status = self._tables.container_live(container.id).status
        reported = {node.tag: node for node in status.nodes} if status else {}
        for tag in container.nodes:
            labels = {"container": container.id, "node": tag}
            consumed = usage.nodes.get(tag, NodeUsage())
            restarts = reported[tag].restarts if tag in reported else 0
            families.counter("rce_node_cpu_seconds", "CPU time.", labels, consumed.cpu_s)
            families.gauge("rce_node_memory_bytes", "Memory in use.", labels, consumed.memory)
            families.gauge("rce_node_processes", "Processes.", labels, consumed.processes)
            families.counter("rce_node_restarts", "Starts after an end of its own.", labels, restarts)


class _Families:
    """Metric families by name, with a limit on their total number of series."""

    def __init__(self, most: int) -> None:
        self.omitted = 0
        self._most = self._room = most
        self._found: dict[str, GaugeMetricFamily | CounterMetricFamily] = {}

    def __iter__(self) -> Iterator[Metric]:
        return iter(self._found.values())

    @property
    def count(self) -> int:
        """Series so far, with those that found no room."""
        return self._most - self._room + self.omitted

    def gauge(self, name: str, help_: str, labels: dict[str, str], value: float) -> None:
        """Add a gauge."""
        self._add(GaugeMetricFamily, name, help_, labels, value)

    def counter(self, name: str, help_: str, labels: dict[str, str], value: float) -> None:
        """Add a counter; ``_total`` is appended to its name."""
        self._add(CounterMetricFamily, name, help_, labels, value)

    def _add(
        self,
        kind: type[GaugeMetricFamily | CounterMetricFamily],
        name: str,
        help_: str,
        labels: dict[str, str],
        value: float,
    ) -> None:
        if self._room <= 0:
            self.omitted += 1
            return
        self._room -= 1
        family = self._found.get(name)
        if family is None:
            family = self._found[name] = kind(name, help_, labels=list(labels))
        family.add_metric(list(labels.values()), value)


class _Metric(NamedTuple):
    """A metric that shows one field of a container's usage."""

    name: str
    help: str
    field: str
    grows: bool = False

    def add(self, families: _Families, labels: dict[str, str], usage: EndpointUsage) -> None:
        """Add the value of one container."""
        add = families.counter if self.grows else families.gauge
        add(self.name, self.help, labels, getattr(usage, self.field))


_CONTAINER = (
    _Metric("rce_container_cpu_seconds", "CPU time.", "cpu_s", grows=True),
    _Metric(
        "rce_container_cpu_throttled_seconds", "Time held back by the CPU limit.", "throttled_s", grows=True
    ),
    _Metric("rce_container_cpu_limit_cores", "Limit of CPU; 0: none.", "cpu_limit"),
    _Metric("rce_container_memory_bytes", "Memory in use.", "memory"),
    _Metric("rce_container_memory_peak_bytes", "The most memory since the start.", "memory_peak"),
    _Metric("rce_container_memory_limit_bytes", "Limit of memory; 0: none.", "memory_limit"),
    _Metric("rce_container_oom_kills", "Processes killed for lack of memory.", "oom_kills", grows=True),
    _Metric("rce_container_processes", "Processes.", "processes"),
)


def _interface(families: _Families, endpoint: str, tag: str, usage: InterfaceUsage | None) -> None:
    counters = usage or InterfaceUsage()
    labels = {"endpoint": endpoint, "interface": tag}
    messages, bytes_ = "Messages; in: from peers.", "Payload bytes; in: from peers."
    for way in ("in", "out"):
        both = {**labels, "direction": way}
        families.counter("rce_messages", messages, both, getattr(counters, f"messages_{way}"))
        families.counter("rce_message_bytes", bytes_, both, getattr(counters, f"bytes_{way}"))
    families.counter(
        "rce_messages_dropped", "Messages that a full queue threw away.", labels, counters.dropped
    )


def _machine(families: _Families, room: Room) -> None:
    labels = {"process": room.process, "machine": room.machine.name}
    machine = room.machine
    for name, there, promised in (
        ("slots", machine.slots, room.slots),
        ("cores", machine.cores, room.cpu),
        ("memory_bytes", machine.memory, room.memory),
    ):
        families.gauge(f"rce_machine_{name}", f"What the machine has of {name}.", labels, there)
        text = f"What its containers are promised of {name}."
        families.gauge(f"rce_machine_promised_{name}", text, labels, promised)
    families.gauge("rce_machine_draining", "1 while it is being emptied.", labels, room.draining)
