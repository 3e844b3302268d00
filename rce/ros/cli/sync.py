"""``rce sync``: registers topics and services of other ROS masters at the local one, like master_sync."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
import uvloop
import yaml

from rce.cli.program_files import from_file
from rce.config import start_logging
from rce.ros.errors import RosError
from rce.ros.multimaster.addresses import split_host
from rce.ros.multimaster.errors import MultimasterError
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.relay.link import DEFAULT_PORT as RELAY_PORT
from rce.ros.multimaster.settings import local_master
from rce.ros.multimaster.sync import MasterSync, SyncSettings
from rce.ros.names import is_graph_name, is_private


def _names(help_: str, *flags: str) -> Any:
    return typer.Option(*flags, help=f"{help_} Separated by commas or repeated; * matches anything.")


@from_file("sync")
def sync(
    topics: Annotated[list[str] | None, _names("Topics to sync.", "--topics", "--sync-topics")] = None,
    services: Annotated[
        list[str] | None, _names("Services to sync.", "--services", "--sync-services")
    ] = None,
    nodes: Annotated[list[str] | None, _names("Nodes to sync.", "--nodes", "--sync-nodes")] = None,
    hosts: Annotated[list[str] | None, _names("Masters to sync with.", "--hosts", "--sync-hosts")] = None,
    ignore: Annotated[
        list[str] | None, _names("Topics and services to leave out; overrides the others.", "--ignore")
    ] = None,
    ignore_topics: Annotated[list[str] | None, _names("Topics to leave out.")] = None,
    ignore_services: Annotated[list[str] | None, _names("Services to leave out.")] = None,
    ignore_nodes: Annotated[list[str] | None, _names("Nodes to leave out.")] = None,
    ignore_hosts: Annotated[list[str] | None, _names("Masters to leave out.")] = None,
    sync_remote_nodes: Annotated[
        bool, typer.Option(help="Also sync nodes that run on another machine than their master.")
    ] = False,
    interface: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="YAML file with these lists, in the format of master_sync."
        ),
    ] = None,
    distinct_names: Annotated[
        bool, typer.Option(help="Register nodes as NODE_at_MASTER to avoid name conflicts.")
    ] = False,
    as_: Annotated[
        list[str] | None,
        typer.Option(
            "--as",
            help="NAMESPACE or MASTER=NAMESPACE: relay the master's topics into a namespace.",
        ),
    ] = None,
    relay: Annotated[
        list[str] | None,
        typer.Option(help="HOST[:PORT] of an rce sync: relay everything over one connection to it."),
    ] = None,
    relay_listen: Annotated[
        int | None, typer.Option(help=f"Accept relay connections on this port (usual: {RELAY_PORT}).")
    ] = None,
    relay_addr: Annotated[str, typer.Option(help="Address for relay connections; default: all.")] = "",
    relay_token: Annotated[
        str, typer.Option(envvar="RCE_RELAY_TOKEN", help="Shared secret of both ends of a relay.")
    ] = "",
    relay_name: Annotated[str, typer.Option(help="Name of this end on relays; default: the master's.")] = "",
    master_uri: Annotated[str, typer.Option(help="URI of the local master; default: ROS_MASTER_URI.")] = "",
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show log messages.")] = False,
) -> None:
    """Sync topics and services of other ROS masters; needs rce discovery."""
    start_logging(logging.INFO if verbose else logging.WARNING, line="%(levelname)s %(message)s")
    chosen = {
        "sync_topics": _split(topics),
        "sync_services": _split(services),
        "sync_nodes": _split(nodes),
        "sync_hosts": _split(hosts),
        "ignore_topics": _split(ignore, ignore_topics),
        "ignore_services": _split(ignore, ignore_services),
        "ignore_nodes": _split(ignore_nodes),
        "ignore_hosts": _split(ignore_hosts),
    }
    if not nodes:
        # With a list of topics no services are synced, and the reverse.
        chosen["ignore_services"] += ["*"] if topics and not services else []
        chosen["ignore_topics"] += ["*"] if services and not topics else []
    try:
        lists = read_lists(interface, chosen)
        lists.sync_remote_nodes = lists.sync_remote_nodes or sync_remote_nodes
        settings = SyncSettings(
            master_uri,
            lists=lists,
            distinct_names=distinct_names,
            namespaces=_namespaces(_split(as_)),
            relay_to=tuple(_address(text) for text in _split(relay)),
            relay_listen=relay_listen,
            relay_addr=relay_addr,
            relay_token=relay_token,
            relay_name=relay_name,
        )
        uvloop.run(run_sync(settings))
    except OSError as error:
        typer.echo(f"rce sync: cannot listen for relay connections: {error.strerror or error}", err=True)
        raise typer.Exit(1) from error
    except (RosError, ValueError) as error:
        typer.echo(f"rce sync: {error}", err=True)
        raise typer.Exit(1) from error


def _split(*options: list[str] | None) -> list[str]:
    """Split values that were repeated or separated by commas."""
    return [name for option in options for text in option or () for name in text.split(",") if name]


def _namespaces(texts: list[str]) -> dict[str, str]:
    pairs = (text.rpartition("=") for text in texts)
    found = {master or "*": namespace for master, _, namespace in pairs}
    for namespace in found.values():
        if not is_graph_name(namespace) or is_private(namespace):
            raise MultimasterError(f"{namespace!r} is not a namespace")
    return found


def _address(text: str) -> tuple[str, int]:
    try:
        return split_host(text, RELAY_PORT)
    except ValueError as error:
        raise MultimasterError(str(error)) from error


def read_lists(file: Path | None, options: Mapping[str, list[Any]]) -> SyncLists:
    """Return the lists of an interface file, with more entries.

    Args:
        file: A YAML file in the format of master_sync; None: no file.
        options: What to add, by list.

    Raises:
        MultimasterError: The file cannot be read, or a list is unknown.
    """
    values: dict[str, Any] = {}
    if file is not None:
        try:
            values = yaml.safe_load(file.read_text("utf-8")) or {}
        except (OSError, yaml.YAMLError) as error:
            raise MultimasterError(f"{file} cannot be read: {error}") from error
        if not isinstance(values, dict):
            raise MultimasterError(f"{file} must hold 'key: value' lines")
    for name, patterns in options.items():
        if patterns:
            before = values.get(name) or []
            values[name] = [*(before if isinstance(before, list) else [before]), *patterns]
    return SyncLists.read(values)


async def run_sync(settings: SyncSettings) -> None:
    """Sync topics and services, until a signal ends it."""
    main = asyncio.current_task()
    assert main is not None
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, main.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        typer.echo(f"waiting for the master at {local_master(settings.master_uri)}")
        async with MasterSync(settings) as running:
            port = f", relay port {running.relay_port}" if running.relay_port else ""
            typer.echo(f"rce sync ready{port}")
            await asyncio.Event().wait()
