"""Starting the processes of a container: its limits, its place in a network, its runtime."""

from __future__ import annotations

import asyncio
import logging
import resource
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from rce.model import EndpointId, Network, Resources
from rce_container.environment import messages as m
from rce_container.exceptions import ContainerError, StartError, StateError, VolumeError
from rce_container.folder import ContainerFolder, Record
from rce_container.limits import ControlGroup, Limiter, limits_of
from rce_container.runtimes.base import Handle, Order, Runtime

if TYPE_CHECKING:
    from rce.control import VolumePlacement
    from rce_container.network import Networks
    from rce_container.network.networks import Membership
    from rce_container.settings import ContainerSettings
    from rce_container.volumes.store import VolumeStore

_log = logging.getLogger(__name__)

ROS_PORT = 11311
LOOPBACK = "127.0.0.1"
PODMAN = "podman"
"""The runtime of containers that have an image."""


class Launched(NamedTuple):
    """The parts of a container whose processes were started."""

    handle: Handle
    control_group: ControlGroup
    isolated: bool
    """See :attr:`rce_container.runtimes.base.Runtime.isolated`."""


class Launcher:
    """Starts containers.

    Args:
        settings: How containers are run.
        runtimes: All runtimes by name.
        runtime: The one for containers that need no other.
        offered: Names of the runtimes that work on this machine.
        limiter: Enforces the containers' limits.
        networks: The networks of groups.
        volumes: The volumes of users.
    """

    def __init__(
        self,
        *,
        settings: ContainerSettings,
        runtimes: Mapping[str, Runtime],
        runtime: Runtime,
        offered: Collection[str],
        limiter: Limiter,
        networks: Networks,
        volumes: VolumeStore,
    ) -> None:
        self._volumes = volumes
        self._settings = settings
        self._runtimes = runtimes
        self._runtime = runtime
        self._offered = offered
        self._limiter = limiter
        self._networks = networks

    def runtime_of(self, record: Record) -> Runtime:
        """Return the runtime that runs a container of an earlier manager."""
        return self._runtimes.get(record.runtime, self._runtime)

    def launch(
        self,
        id_: str,
        folder: ContainerFolder,
        resources: Resources,
        placements: Sequence[VolumePlacement] = (),
    ) -> Launched:
        """Start a container's first process, and write its record to its folder.

        Args:
            id_: The container.
            folder: Of its incarnation.
            resources: What it asks for.
            placements: Which files its volumes are to have.

        Raises:
            ContainerError: It cannot be started. :meth:`undo` removes what was made of it.
            OSError: A resource of the machine is exhausted.
        """
        runtime = self._runtime_for(resources)
        mounts = self._volumes.claim(
            EndpointId.parse(id_).user, folder.incarnation_id, resources.volumes, placements
        )
        if not runtime.isolated and any(mount.image for mount in mounts):
            raise VolumeError(f"its volumes are file systems, which the runtime {runtime.name} cannot mount")
        control_group = self._limiter.create(folder.incarnation_id, limits_of(resources, self._settings))
        membership = self._enroll(id_, folder, resources)
        boot = self._boot(id_, folder, resources, runtime, control_group, membership)
        with folder.listen(folder.control_socket) as control, folder.listen(folder.link_socket) as links:
            order = Order(
                EndpointId.parse(id_).tag,
                boot,
                folder,
                self._settings.packages,
                control.fileno(),
                links.fileno(),
                join=control_group.join,
                host_network=resources.network is Network.HOST,
                switch=membership.path if membership else "",
                image=resources.image or runtime.image,
                volumes=mounts,
            )
            handle = runtime.start(order)
        process = handle.process
        record = Record(
            id=id_,
            incarnation_id=folder.incarnation_id,
            runtime=runtime.name,
            pid=process.pid,
            start=process.start,
            group=resources.group if membership else "",
            address=str(membership.address) if membership else "",
            volumes={volume.name: volume.path for volume in resources.volumes},
        )
        try:
            folder.write_record(record)
        except StateError:
            handle.discard()
            raise
        return Launched(handle, control_group, runtime.isolated)

    async def undo(self, incarnation_id: str) -> None:
        """Remove a container's control group with all its processes, and its place in a network."""
        control_group = self._limiter.adopt(incarnation_id)
        try:
            await asyncio.to_thread(control_group.kill)
            await asyncio.to_thread(control_group.remove)
        except ContainerError as error:
            _log.error("a container that did not start: %s", error)
        await self._networks.detach(incarnation_id)

    def _runtime_for(self, resources: Resources) -> Runtime:
        """Return the runtime that makes a container: an image needs one that can run images.

        Raises:
            StartError: None here can.
        """
        runtime = self._runtime
        if resources.image and runtime.name != PODMAN:
            if PODMAN not in self._offered:
                raise StartError(f"its image needs the runtime {PODMAN}, which does not work on this machine")
            runtime = self._runtimes[PODMAN]
        if resources.network is Network.GROUP and not runtime.isolated:
            raise StartError(f"the runtime {runtime.name} has no networks of groups")
        return runtime

    def _enroll(self, id_: str, folder: ContainerFolder, resources: Resources) -> Membership | None:
        if resources.network is not Network.GROUP:
            return None
        return self._networks.enroll(
            EndpointId.parse(id_), resources.group, resources.group_ip, folder.incarnation_id, folder.hosts
        )

    def _boot(
        self,
        id_: str,
        folder: ContainerFolder,
        resources: Resources,
        runtime: Runtime,
        control_group: ControlGroup,
        membership: Membership | None,
    ) -> m.Boot:
        settings = self._settings
        own_network = runtime.isolated and resources.network is not Network.HOST
        return m.Boot(
            id=id_,
            mark=folder.incarnation_id,
            machine=settings.machine,
            tls=settings.tls,
            home="",
            logs="",
            ros_port=ROS_PORT if own_network else 0,
            isolated=runtime.isolated,
            address=str(membership.address.ip) if membership else LOOPBACK,
            rlimits=_rlimits(control_group, isolated=runtime.isolated),
            packages=tuple(map(str, settings.packages)),
            user_packages=runtime.user_packages(folder),
            grace=settings.grace,
            interrupt_timeout=settings.interrupt_timeout,
            terminate_timeout=settings.terminate_timeout,
        )


def _rlimits(control_group: ControlGroup, *, isolated: bool) -> dict[int, int]:
    """Return the limits that the container's processes set for themselves."""
    rlimits = dict(control_group.rlimits)
    if not isolated:
        rlimits.pop(resource.RLIMIT_NPROC, None)  # the kernel would count all processes of this user
    return rlimits
