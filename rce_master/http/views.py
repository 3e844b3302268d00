"""Builds the API's answers from the state's tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.control import EndpointUsage, InterfaceUsage, NodeStatus, Usage
from rce_master.http import models, spec_models
from rce_master.http.spec_models import shown
from rce_master.state import capacity, volume_moves
from rce_master.state.lifecycle import ContainerPhase
from rce_master.state.records import Container, Endpoint, Robot, TaskSet
from rce_master.state.user_records import User
from rce_master.state.volume_records import UserVolume
from rce_master.state.volumes import holder_of, volumes_of
from rce_master.state.wiring_records import Connection, Interface, open_end_key

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rce_master.state.tables import Tables

_UNKNOWN = "unknown"
_NO_USAGE = EndpointUsage()
_NO_INTERFACE_USAGE = InterfaceUsage()


class Views:
    """Shows users, robots, containers and their parts.

    Args:
        tables: The state's tables.
        usage: The last usage report of each task set.
    """

    def __init__(self, tables: Tables, usage: Mapping[str, Usage]) -> None:
        self._tables = tables
        self._usage = usage

    def user(self, user: User) -> models.UserOut:
        """Show a user."""
        return models.UserOut(
            name=user.name,
            role=user.role.value,
            created=user.created,
            robots=self._tables.endpoints.count("robots_of", user.name),
            containers=self._tables.endpoints.count("containers_of", user.name),
        )

    def robot(self, robot: Robot) -> models.RobotOut:
        """Show a robot."""
        return models.RobotOut(
            id=robot.id,
            user=robot.user,
            tag=robot.tag,
            state=self._tables.robot_live(robot.id).session.value,
            task_set=robot.task_set,
            revision=robot.revision,
            interfaces=self._tables.interfaces.count("endpoint", robot.id),
        )

    def volume(self, known: UserVolume) -> dict[str, Any]:
        """Show a volume."""
        task_set = self._tables.task_sets.get(known.process)
        usage = self._usage.get(known.process)
        holder = holder_of(self._tables, known.user, known.name)
        volumes = () if holder is None else holder.resources.volumes
        return {
            "user": known.user,
            "name": known.name,
            "size": known.size,
            "used": None if usage is None else usage.volumes.get(known.id),
            "machine": "" if task_set is None else task_set.machine.name,
            "task_set": known.process,
            "limit": "" if task_set is None else task_set.machine.volumes,
            "container": "" if holder is None else holder.tag,
            "path": next((volume.path for volume in volumes if volume.name == known.name), ""),
            "snapshots": known.snapshots,
            "snapshot": known.taken or None,
            "kept": known.kept,
            "fault": known.fault,
        }

    def container(self, container: Container) -> spec_models.ContainerOut:
        """Show a container."""
        live = self._tables.container_live(container.id)
        task_set = self._tables.task_sets.get(container.task_set)
        usage = self.usage_of(container)
        return spec_models.ContainerOut(
            id=container.id,
            user=container.user,
            tag=container.tag,
            state=live.phase.value,
            detail=self._moving(container) or (live.status.detail if live.status else "") or live.stays,
            task_set=container.task_set,
            machine=task_set.machine.name if task_set else "",
            revision=container.revision,
            incarnation=live.status.incarnation if live.status else "",
            nodes=len(container.nodes),
            interfaces=self._tables.interfaces.count("endpoint", container.id),
            cpu_s=usage.cpu_s,
            memory=usage.memory,
            wish=spec_models.RequestedOut(**shown(container.resources)),
            moving_to=self._moves_to(container),
        )

    def node_states(self, container: Container) -> list[str]:
        """Return the states of all nodes of a container."""
        status = self._tables.container_live(container.id).status
        reported = {node.tag: node.state.value for node in status.nodes} if status else {}
        return [reported.get(tag, _UNKNOWN) for tag in container.nodes]

    def nodes(self, container: Container, tags: Iterable[str]) -> list[spec_models.NodeOut]:
        """Show nodes of a container."""
        status = self._tables.container_live(container.id).status
        reported = {node.tag: node for node in status.nodes} if status else {}
        return [self._node(container, tag, reported.get(tag)) for tag in tags]

    def _node(self, container: Container, tag: str, status: NodeStatus | None) -> spec_models.NodeOut:
        return spec_models.NodeOut(
            **shown(container.nodes[tag]),
            user=container.user,
            container=container.tag,
            state=status.state.value if status else _UNKNOWN,
            pid=status.pid if status else 0,
            exit_code=status.exit_code if status else None,
            detail=status.detail if status else "",
            restarts=status.restarts if status else 0,
        )

    def parameter(self, container: Container, name: str) -> spec_models.ParameterOut:
        """Show a parameter of a container."""
        return spec_models.ParameterOut(
            user=container.user, container=container.tag, name=name, value=container.parameters[name]
        )

    def interface(self, endpoint: Endpoint, interface: Interface) -> spec_models.InterfaceOut:
        """Show an interface of a robot or container."""
        usage = self.usage_of(endpoint).interfaces
        return spec_models.InterfaceOut(
            **shown(interface.spec),
            user=endpoint.user,
            endpoint=endpoint.tag,
            active=interface.id in self._tables.active,
            **_counters(usage.get(interface.spec.tag, _NO_INTERFACE_USAGE)),
        )

    def connection(self, connection: Connection) -> spec_models.ConnectionOut:
        """Show a connection."""
        user, _, tag_a = connection.a.partition("/")
        tag_b = connection.b.partition("/")[2]
        return spec_models.ConnectionOut(
            id=connection.id,
            user=user,
            tag_a=f"{tag_a}/{connection.interface_a}",
            tag_b=f"{tag_b}/{connection.interface_b}",
            established=self.is_established(connection),
        )

    def machine(self, task_set: TaskSet) -> models.MachineOut:
        """Show a task set."""
        usage = self._usage.get(task_set.process)
        machine = task_set.machine
        room = capacity.room_at(self._tables, task_set)
        return models.MachineOut(
            process=task_set.process,
            kind=task_set.kind.value,
            machine=machine.name,
            connected=self._tables.is_connected(task_set.process),
            endpoints=self._tables.endpoints.count("task_set", task_set.process),
            cores=machine.cores,
            memory=machine.memory,
            runtime=machine.runtime,
            labels=list(machine.labels),
            detail=machine.detail,
            url=task_set.url,
            cpu_s=usage.cpu_s if usage else 0.0,
            memory_used=usage.memory if usage else 0,
            slots=machine.slots,
            limits=machine.limits,
            networks=list(machine.networks),
            runtimes=list(machine.runtimes),
            promised_slots=room.slots,
            promised_cores=round(room.cpu, 4),
            promised_memory=room.memory,
            draining=room.draining or task_set.process in self._tables.drains,
            staying=self.staying(task_set) if room.draining else [],
        )

    def staying(self, task_set: TaskSet) -> list[models.StayingOut]:
        """Show the containers that a draining machine still has, and why."""
        return [
            models.StayingOut(container=container.id, why=self._why_it_stays(container))
            for container in self._tables.endpoints.by("task_set", task_set.process)
            if isinstance(container, Container)
        ]

    def _moves_to(self, container: Container) -> str:
        move = self._tables.moves.get(container.id) or self._tables.volume_moves.get(container.id)
        if move is not None:
            return move.to
        phase = self._tables.container_live(container.id).phase
        starts = phase in (ContainerPhase.PLACED, ContainerPhase.STARTING)
        former = any(known.former for known in volumes_of(self._tables, container))
        return container.task_set if starts and former else ""

    def _moving(self, container: Container) -> str:
        move = self._tables.volume_moves.get(container.id)
        return "" if move is None else volume_moves.describe(move)

    def _why_it_stays(self, container: Container) -> str:
        if moving := self._moving(container):
            return moving
        move = self._tables.moves.get(container.id)
        if move is not None:
            return f"is being handed over to {move.to}"
        live = self._tables.container_live(container.id)
        return live.stays or "its turn comes"

    def usage_of(self, endpoint: Endpoint) -> EndpointUsage:
        """Return the usage of an endpoint."""
        usage = self._usage.get(endpoint.task_set)
        return usage.endpoints.get(endpoint.id, _NO_USAGE) if usage else _NO_USAGE

    def is_established(self, connection: Connection) -> bool:
        """Return whether both ends report a connection as established."""
        ends = (open_end_key(endpoint, connection.id) for endpoint in (connection.a, connection.b))
        return all(key in self._tables.open_ends for key in ends)


def _counters(usage: InterfaceUsage) -> dict[str, int]:
    return {name: getattr(usage, name) for name in usage.__struct_fields__}
