"""``GET /metrics``: what Prometheus scrapes, made of the state at the moment of the request."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, GCCollector, PlatformCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from rce_master.http.views import Views
from rce_master.state.lifecycle import ContainerPhase, RobotSession

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from prometheus_client.metrics_core import Metric

    from rce.control.messages import Usage
    from rce_master.state.tables import Tables


def make_registry(tables: Tables, usage: Mapping[str, Usage]) -> CollectorRegistry:
    """Make a registry of our own; the library's global one belongs to whoever embeds us."""
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    PlatformCollector(registry=registry)
    GCCollector(registry=registry)
    registry.register(EngineCollector(tables, usage))
    return registry


class EngineCollector(Collector):
    """Robots, containers, nodes, connections, task sets and traffic."""

    def __init__(self, tables: Tables, usage: Mapping[str, Usage]) -> None:
        self._tables = tables
        self._usage = usage
        self._views = Views(tables, usage)

    def collect(self) -> Iterator[Metric]:
        """Make all metrics."""
        yield from self._states()
        yield from self._connections()
        yield from self._task_sets()
        yield from self._traffic()
        yield from self._consumption()

    def _states(self) -> Iterator[Metric]:
        tables = self._tables
        sessions = Counter(tables.robot_live(robot.id).session for robot in tables.robots())
        yield _gauge(
            "rce_robots",
            "Robots by session.",
            "session",
            {s.value: sessions[s] for s in RobotSession if s is not RobotSession.OFFLINE},
        )
        phases = Counter(tables.container_live(container.id).phase for container in tables.containers())
        yield _gauge(
            "rce_containers", "Containers by state.", "state", {p.value: phases[p] for p in ContainerPhase}
        )
        nodes = Counter(node.state for c in tables.containers() for node in self._views.nodes(c))
        yield _gauge("rce_nodes", "Nodes by state.", "state", nodes)
        yield GaugeMetricFamily("rce_users", "Users.", value=len(tables.users))
        revision = tables.counters.get("revision")
        yield CounterMetricFamily(
            "rce_revisions", "Changes of desired state.", value=revision.value if revision else 0
        )

    def _connections(self) -> Iterator[Metric]:
        shown = [c for link in self._tables.links for c in self._views.connections(link)]
        established = sum(c.established for c in shown)
        values = {"established": established, "waiting": len(shown) - established}
        yield _gauge("rce_connections", "Connections by state.", "state", values)

    def _task_sets(self) -> Iterator[Metric]:
        labels = ["process", "kind"]
        connected = GaugeMetricFamily("rce_task_set_connected", "1 while connected.", labels=labels)
        endpoints = GaugeMetricFamily("rce_task_set_endpoints", "Robots or containers there.", labels=labels)
        cpu = CounterMetricFamily("rce_task_set_cpu_seconds", "CPU time.", labels=labels)
        memory = GaugeMetricFamily("rce_task_set_memory_bytes", "Resident memory.", labels=labels)
        for task_set in self._tables.task_sets:
            shown = self._views.machine(task_set)
            key = [shown.process, shown.kind]
            connected.add_metric(key, shown.connected)
            endpoints.add_metric(key, shown.endpoints)
            cpu.add_metric(key, shown.cpu_s)
            memory.add_metric(key, shown.memory_used)
        yield from (connected, endpoints, cpu, memory)

    def _traffic(self) -> Iterator[Metric]:
        labels = ["endpoint", "interface", "direction"]
        messages = CounterMetricFamily("rce_messages", "Messages; in: from peers.", labels=labels)
        bytes_ = CounterMetricFamily("rce_message_bytes", "Payload bytes; in: from peers.", labels=labels)
        dropped = CounterMetricFamily(
            "rce_messages_dropped", "Messages that a full queue threw away.", labels=labels[:2]
        )
        for endpoint in self._tables.endpoints:
            for tag, counters in self._views.usage_of(endpoint).interfaces.items():
                messages.add_metric([endpoint.id, tag, "in"], counters.messages_in)
                messages.add_metric([endpoint.id, tag, "out"], counters.messages_out)
                bytes_.add_metric([endpoint.id, tag, "in"], counters.bytes_in)
                bytes_.add_metric([endpoint.id, tag, "out"], counters.bytes_out)
                dropped.add_metric([endpoint.id, tag], counters.dropped)
        yield from (messages, bytes_, dropped)

    def _consumption(self) -> Iterator[Metric]:
        cpu = CounterMetricFamily("rce_container_cpu_seconds", "CPU time.", labels=["container"])
        memory = GaugeMetricFamily("rce_container_memory_bytes", "Resident memory.", labels=["container"])
        processes = GaugeMetricFamily("rce_container_processes", "Processes.", labels=["container"])
        for container in self._tables.containers():
            usage = self._views.usage_of(container)
            cpu.add_metric([container.id], usage.cpu_s)
            memory.add_metric([container.id], usage.memory)
            processes.add_metric([container.id], usage.processes)
        yield from (cpu, memory, processes)


def _gauge(name: str, help_: str, label: str, values: Mapping[str, int]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, help_, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family
