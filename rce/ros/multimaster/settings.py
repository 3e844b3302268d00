"""Settings of a discovery; names and meanings are those of master_discovery's parameters."""

from __future__ import annotations

import os
from dataclasses import dataclass
from urllib.parse import urlsplit

from rce.ros.multimaster.addresses import (
    DEFAULT_GROUP,
    DEFAULT_MASTER_PORT,
    DEFAULT_PORT,
    RPC_PORT_OFFSET,
    split_host,
)
from rce.ros.multimaster.heartbeat import MAX_RATE
from rce.ros.multimaster.peer_table import LivenessSettings
from rce.ros.node.settings import DEFAULT_MASTER_URI

_LIVENESS = LivenessSettings()


def local_master(uri: str = "") -> str:
    """Return ``uri``, or ``ROS_MASTER_URI``, or the default master of this machine."""
    return uri or os.environ.get("ROS_MASTER_URI", "") or DEFAULT_MASTER_URI


@dataclass(frozen=True, slots=True)
class DiscoverySettings:
    """Settings of one discovery."""

    master_uri: str = ""
    """The master to announce; if empty, ``ROS_MASTER_URI``."""
    name: str = ""
    """The master's name; if empty, its host and, if unusual, its port."""
    node_name: str = "master_discovery"
    mcast_group: str = DEFAULT_GROUP
    """IPv4 group as ``group@interface``; the interface may be a name or an address."""
    mcast_port: int = DEFAULT_PORT
    rpc_port: int = 0
    """Port of the RPC server; 0: the master's plus 300."""
    rpc_addr: str = ""
    """Address that the RPC server listens on; if empty, all."""
    heartbeat_hz: float = 1.0
    rosmaster_hz: float = 1.0
    """How often the master is asked for changes."""
    measurement_intervals: float = _LIVENESS.measurement_intervals
    timeout_factor: float = _LIVENESS.timeout_factor
    active_request_after: float = _LIVENESS.active_request_after
    remove_after: float = _LIVENESS.remove_after
    robot_hosts: tuple[str, ...] = ()
    """Hosts (``HOST`` or ``HOST:PORT``) that get heartbeats of their own, where multicast does not reach."""
    send_mcast: bool = True
    listen_mcast: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.heartbeat_hz <= MAX_RATE:
            raise ValueError(
                f"heartbeat_hz must be above 0 and at most {MAX_RATE}, not {self.heartbeat_hz:g}"
            )
        if not self.rosmaster_hz > 0:
            raise ValueError(f"rosmaster_hz must be above 0, not {self.rosmaster_hz:g}")
        for host in self.robot_hosts:
            split_host(host, self.mcast_port)

    @property
    def liveness(self) -> LivenessSettings:
        """When a silent master counts as gone."""
        return LivenessSettings(
            self.measurement_intervals,
            self.timeout_factor,
            self.active_request_after,
            self.rosmaster_hz,
            self.remove_after,
        )

    @property
    def robot_addresses(self) -> list[tuple[str, int]]:
        """The robot hosts with their ports."""
        return [split_host(host, self.mcast_port) for host in self.robot_hosts]

    def rpc_port_for(self, master_uri: str) -> int:
        """Return the RPC server's port for a master."""
        return self.rpc_port or (urlsplit(master_uri).port or DEFAULT_MASTER_PORT) + RPC_PORT_OFFSET
