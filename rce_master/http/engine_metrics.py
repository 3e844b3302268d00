"""Metrics of the engine as a whole: how many robots, containers, nodes and connections, and its task sets."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from rce_master.http.metrics_pieces import in_pieces, write_pieces
from rce_master.http.views import Views
from rce_master.state.lifecycle import ContainerPhase, RobotSession
from rce_master.state.records import Container

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from prometheus_client.metrics_core import Metric

    from rce.control import Usage
    from rce_master.state.tables import Tables


class EngineMetrics:
    """Metrics of robots, containers, nodes, connections and task sets, counted in pieces."""

    def __init__(self, tables: Tables, usage: Mapping[str, Usage]) -> None:
        self._tables = tables
        self._usage = usage
        self._views = Views(tables, usage)

    async def parts(self) -> AsyncIterator[bytes]:
        """Write all metrics, in parts of at most :data:`PIECE` series."""
        for metric in (*await self._states(), await self._connections(), *await self._task_sets()):
            for piece in write_pieces(metric):
                yield piece

    async def _states(self) -> list[Metric]:
        tables = self._tables
        sessions: Counter[RobotSession] = Counter()
        phases: Counter[ContainerPhase] = Counter()
        nodes: Counter[str] = Counter()
        async for endpoint in in_pieces(tables.endpoints):
            if isinstance(endpoint, Container):
                phases[tables.container_live(endpoint.id).phase] += 1
                nodes.update(self._views.node_states(endpoint))
            else:
                sessions[tables.robot_live(endpoint.id).session] += 1
        shown_sessions = {s.value: sessions[s] for s in RobotSession if s is not RobotSession.OFFLINE}
        shown_phases = {phase.value: phases[phase] for phase in ContainerPhase}
        revision = next((counter.value for counter in tables.counters if counter.name == "revision"), 0)
        return [
            _gauge("rce_robots", "Robots by session.", "session", shown_sessions),
            _gauge("rce_containers", "Containers by state.", "state", shown_phases),
            _gauge("rce_nodes", "Nodes by state.", "state", nodes),
            GaugeMetricFamily("rce_users", "Users.", value=len(tables.users)),
            CounterMetricFamily(
                "rce_revisions",
                "Changes of desired state since the start.",
                value=revision - tables.first_revision,
            ),
        ]

    async def _connections(self) -> Metric:
        states = Counter({"established": 0, "waiting": 0})
        async for connection in in_pieces(self._tables.connections):
            states["established" if self._views.is_established(connection) else "waiting"] += 1
        return _gauge("rce_connections", "Connections by state.", "state", states)

    async def _task_sets(self) -> list[Metric]:
        labels = ["process", "kind"]
        connected = GaugeMetricFamily("rce_task_set_connected", "1 while connected.", labels=labels)
        endpoints = GaugeMetricFamily("rce_task_set_endpoints", "Robots or containers there.", labels=labels)
        cpu = CounterMetricFamily("rce_task_set_cpu_seconds", "CPU time.", labels=labels)
        memory = GaugeMetricFamily("rce_task_set_memory_bytes", "Resident memory.", labels=labels)
        held = GaugeMetricFamily(
            "rce_task_set_held_bytes", "Of messages that wait or are incomplete.", labels=labels
        )
        shed = CounterMetricFamily(
            "rce_task_set_shed", "Times that a user held too much and lost the oldest of it.", labels=labels
        )
        turned_away = CounterMetricFamily(
            "rce_task_set_turned_away",
            "Connections closed because too many did not say who they are.",
            labels=labels,
        )
        async for task_set in in_pieces(self._tables.task_sets):
            shown = self._views.machine(task_set)
            key = [shown.process, shown.kind]
            connected.add_metric(key, shown.connected)
            endpoints.add_metric(key, shown.endpoints)
            cpu.add_metric(key, shown.cpu_s)
            memory.add_metric(key, shown.memory_used)
            if (usage := self._usage.get(task_set.process)) is not None:
                held.add_metric(key, usage.held)
                shed.add_metric(key, usage.shed)
                turned_away.add_metric(key, usage.turned_away)
        return [connected, endpoints, cpu, memory, held, shed, turned_away]


def _gauge(name: str, help_: str, label: str, values: Mapping[str, int]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, help_, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family
