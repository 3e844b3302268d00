"""``rce discovery``: announces this machine's ROS master and finds others, as master_discovery does."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from typing import Annotated

import typer
import uvloop

from rce.cli.program_files import from_file
from rce.config import start_logging
from rce.ros.errors import RosError
from rce.ros.multimaster.discovery import Discovery
from rce.ros.multimaster.listing import list_masters
from rce.ros.multimaster.peer_table import Neighbour, PeerEvent
from rce.ros.multimaster.settings import DiscoverySettings, local_master

_DEFAULT = DiscoverySettings()


@from_file("discovery", leave_out=("list",))
def discovery(
    list_: Annotated[
        bool, typer.Option("--list", help="Print the masters that the running discovery knows, and exit.")
    ] = False,
    master_uri: Annotated[str, typer.Option(help="URI of the local master; default: ROS_MASTER_URI.")] = "",
    name: Annotated[str, typer.Option(help="Name of this master; default: its host.")] = "",
    mcast_group: Annotated[
        str, typer.Option(help="Multicast group as GROUP@INTERFACE; INTERFACE is a name or an address.")
    ] = _DEFAULT.mcast_group,
    mcast_port: Annotated[
        int, typer.Option(min=1, max=65535, help="UDP port of heartbeats.")
    ] = _DEFAULT.mcast_port,
    rpc_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the RPC server; 0: the master's plus 300.")
    ] = 0,
    rpc_addr: Annotated[str, typer.Option(help="Address of the RPC server; default: all.")] = "",
    heartbeat_hz: Annotated[float, typer.Option(help="Heartbeats per second.")] = _DEFAULT.heartbeat_hz,
    rosmaster_hz: Annotated[
        float, typer.Option(help="Polls of the local master per second.")
    ] = _DEFAULT.rosmaster_hz,
    measurement_intervals: Annotated[
        float, typer.Option(help="Number of heartbeats over which link quality is measured.")
    ] = _DEFAULT.measurement_intervals,
    timeout_factor: Annotated[
        float, typer.Option(help="Silence after which a master is offline, as a fraction of the measurement.")
    ] = _DEFAULT.timeout_factor,
    active_request_after: Annotated[
        float, typer.Option(help="Seconds of silence after which a master is asked for a heartbeat.")
    ] = _DEFAULT.active_request_after,
    remove_after: Annotated[
        float, typer.Option(help="Seconds after which an offline master is removed; 0: never.")
    ] = _DEFAULT.remove_after,
    robot_hosts: Annotated[
        list[str] | None,
        typer.Option("--robot-host", help="HOST[:PORT] outside multicast; may be repeated."),
    ] = None,
    send_mcast: Annotated[bool, typer.Option(help="Send heartbeats to the multicast group.")] = True,
    listen_mcast: Annotated[bool, typer.Option(help="Receive heartbeats of the multicast group.")] = True,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show log messages.")] = False,
) -> None:
    """Announce this machine's ROS master and find others."""
    start_logging(logging.INFO if verbose else logging.WARNING, line="%(levelname)s %(message)s")
    try:
        settings = DiscoverySettings(
            master_uri=master_uri,
            name=name,
            mcast_group=mcast_group,
            mcast_port=mcast_port,
            rpc_port=rpc_port,
            rpc_addr=rpc_addr,
            heartbeat_hz=heartbeat_hz,
            rosmaster_hz=rosmaster_hz,
            measurement_intervals=measurement_intervals,
            timeout_factor=timeout_factor,
            active_request_after=active_request_after,
            remove_after=remove_after,
            robot_hosts=tuple(robot_hosts or ()),
            send_mcast=send_mcast,
            listen_mcast=listen_mcast,
        )
        uvloop.run(_list(master_uri) if list_ else run_discovery(settings))
    except (RosError, ValueError) as error:
        typer.echo(f"rce discovery: {error}", err=True)
        raise typer.Exit(1) from error
    except OSError as error:
        typer.echo(f"rce discovery: cannot listen: {error.strerror or error}", err=True)
        raise typer.Exit(1) from error


async def run_discovery(settings: DiscoverySettings) -> None:
    """Announce a master and print what is found, until a signal ends it."""
    main = asyncio.current_task()
    assert main is not None
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, main.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        typer.echo(f"waiting for the master at {local_master(settings.master_uri)}")
        running = Discovery(settings)
        with running.watch() as events:
            async with running:
                typer.echo(f"rce discovery ready: {running.monitor_uri}")
                async for event in events:
                    typer.echo(_describe_event(event))


async def _list(master_uri: str) -> None:
    masters = await list_masters(local_master(master_uri))
    width = max((len(master.name) for master in masters), default=0)
    for master in sorted(masters, key=lambda master: master.name):
        typer.echo(f"{master.name:{width}}  {_state(master):7}  {master.uri}  {master.monitor_uri}")


def _describe_event(event: PeerEvent) -> str:
    master = event.master
    return f"{event.change.value:7}  {master.name}  {_state(master)}  {master.uri}"


def _state(master: Neighbour) -> str:
    return "online" if master.online else "offline"
