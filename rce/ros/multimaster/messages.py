"""The messages of discovery and synchronization (``fkie_multimaster_msgs``), to and from our values.

The definitions in ``share`` are those of fkie's releases 1.1.0 to 1.3.2.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rce.ros.multimaster.heartbeat import Stamp
from rce.ros.multimaster.monitor import Origins
from rce.ros.multimaster.peer_table import Neighbour, PeerChange, PeerEvent
from rce.ros.multimaster.plan import Registration, RegistrationKind
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.ros.types.exceptions import TypesError
from rce.ros.types.values import Time

_log = logging.getLogger(__name__)

PACKAGE = "fkie_multimaster_msgs"
ROS_MASTER = f"{PACKAGE}/ROSMaster"
MASTER_STATE = f"{PACKAGE}/MasterState"
LINK_STATES = f"{PACKAGE}/LinkStatesStamped"
DISCOVER_MASTERS = f"{PACKAGE}/DiscoverMasters"
GET_SYNC_INFO = f"{PACKAGE}/GetSyncInfo"
EMPTY = "std_srvs/Empty"


def registry() -> TypeRegistry:
    """Make a registry that knows these types besides those of the environment.

    An installed ``fkie_multimaster_msgs`` is used if its ``ROSMaster`` is that of release 1.1.0 or later.
    """
    path = PackageIndex.from_environ().path
    share = Path(__file__).with_name("share")
    types, ours = TypeRegistry(PackageIndex([*path, share])), TypeRegistry(PackageIndex([share]))
    expected = ours.message(ROS_MASTER).md5sum
    try:
        found = types.message(ROS_MASTER).md5sum
    except TypesError as error:
        found = str(error)
    if found == expected:
        return types
    _log.warning(
        "the installed %s is not that of release 1.1.0 or later and is not used: expected %s with md5 sum %s,"
        " found %s",
        PACKAGE,
        ROS_MASTER,
        expected,
        found,
    )
    return TypeRegistry(PackageIndex([share, *path]))


def master_state(event: PeerEvent) -> dict[str, Any]:
    """Write a ``MasterState``."""
    return {"state": event.change.value, "master": ros_master(event.master)}


def read_master_state(message: Any) -> PeerEvent:
    """Read a ``MasterState``, its state with the quotes that older definitions have or without.

    Raises:
        ValueError: Its state is not one of the three.
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
