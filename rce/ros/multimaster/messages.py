"""The messages of discovery and synchronization (``fkie_multimaster_msgs``), to and from our values."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rce.ros.multimaster.heartbeat import Stamp
from rce.ros.multimaster.monitor import Origins
from rce.ros.multimaster.neighbourhood import Neighbour, PeerChange, PeerEvent
from rce.ros.multimaster.plan import Registration, RegistrationKind
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.ros.types.values import Time

PACKAGE = "fkie_multimaster_msgs"
MASTER_STATE = f"{PACKAGE}/MasterState"
LINK_STATES = f"{PACKAGE}/LinkStatesStamped"
DISCOVER_MASTERS = f"{PACKAGE}/DiscoverMasters"
GET_SYNC_INFO = f"{PACKAGE}/GetSyncInfo"
EMPTY = "std_srvs/Empty"


def registry() -> TypeRegistry:
    """Make a registry that knows these types besides those of the environment."""
    path = PackageIndex.from_environ().path
    return TypeRegistry(PackageIndex([*path, Path(__file__).with_name("share")]))


def master_state(event: PeerEvent) -> dict[str, Any]:
    """Write a ``MasterState``. Its constants hold the quotes of the definition, as fkie's do."""
    return {"state": f"'{event.change.value}'", "master": ros_master(event.master)}


def read_master_state(message: Any) -> PeerEvent:
    """Read a ``MasterState``.

    Raises:
        ValueError: Its state is none of the three.
    """
    return PeerEvent(PeerChange(message.state.strip("'\"")), read_ros_master(message.master))


def ros_master(master: Neighbour) -> dict[str, Any]:
    """Write a ``ROSMaster``."""
    return {
        "name": master.name,
        "uri": master.uri,
        "last_change": _time(master.stamp),
        "last_change_local": _time(master.stamp_local),
        "online": master.online,
        "discoverer_name": master.discoverer,
        "monitoruri": master.monitor_uri,
    }


def _time(stamp: Stamp) -> Time:
    """A ROS time has no sign; a heartbeat's stamp may have one by mistake."""
    return Time(max(0, stamp.secs), max(0, stamp.nsecs))


def read_ros_master(message: Any) -> Neighbour:
    """Read a ``ROSMaster``."""
    return Neighbour(
        message.name,
        message.uri,
        message.monitoruri,
        message.discoverer_name,
        message.online,
        Stamp(message.last_change.secs, message.last_change.nsecs),
        Stamp(message.last_change_local.secs, message.last_change_local.nsecs),
    )


def sync_master_info(master_uri: str, entries: Iterable[Registration]) -> dict[str, Any]:
    """Write a ``SyncMasterInfo``: what is registered here of one master."""
    held = sorted(entries, key=lambda entry: (entry.kind.value, entry.name, entry.node))

    def topics(kind: RegistrationKind) -> list[dict[str, str]]:
        return [
            {"topic": entry.name, "node": entry.node, "nodeuri": entry.uri}
            for entry in held
            if entry.kind is kind
        ]

    return {
        "masteruri": master_uri,
        "nodes": sorted({entry.node for entry in held}),
        "publisher": topics(RegistrationKind.PUBLISHER),
        "subscriber": topics(RegistrationKind.SUBSCRIBER),
        "services": [
            {"service": entry.name, "serviceuri": entry.detail, "node": entry.node, "nodeuri": entry.uri}
            for entry in held
            if entry.kind is RegistrationKind.SERVICE
        ],
    }


def read_origins(hosts: Iterable[Any]) -> Origins:
    """Read the ``SyncMasterInfo`` of all masters."""
    nodes: dict[tuple[str, str], str] = {}
    services: dict[tuple[str, str], str] = {}
    for host in hosts:
        for entry in (*host.publisher, *host.subscriber, *host.services):
            nodes[entry.node, entry.nodeuri] = host.masteruri
        for entry in host.services:
            services[entry.service, entry.serviceuri] = host.masteruri
    return Origins(nodes, services)
