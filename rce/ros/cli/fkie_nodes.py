"""fkie's nodes ``master_discovery`` and ``master_sync``, with their private parameters, as ours.

``rce run master_discovery_fkie master_discovery _mcast_group:=224.0.0.1`` is ``rce discovery``, and
``rce run master_sync_fkie master_sync _sync_topics:="[/a, /b]"`` is ``rce sync``. Parameters may be on the
command line, or at the master, where a launch file puts them. Those of the command line override the others,
and are put there too. Parameters that ours do not have are named in a warning: a launch file that starts
fkie's nodes starts ours.
"""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rce.ros.cli.discovery import run_discovery
from rce.ros.cli.sync import read_lists, run_sync
from rce.ros.errors import MasterRefusedError, MasterUnreachableError, RosError
from rce.ros.multimaster.announcements import URI_PARAMETER
from rce.ros.multimaster.errors import MultimasterError
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.registrar import RECORD
from rce.ros.multimaster.settings import DiscoverySettings, local_master
from rce.ros.multimaster.sync import SyncSettings
from rce.ros.names import parse_arguments
from rce.ros.node import run
from rce.ros.node.master import MasterClient
from rce.ros.node.settings import NodeSettings
from rce.ros.xmlrpc import RpcClient

_log = logging.getLogger(__name__)

MASTER_POLL = 0.5
"""Seconds between two attempts to reach the master."""
_OWN = ("master_uri", "node_name")
"""Settings that have no parameter of their own."""
_DISCOVERY = {field.name: field.type for field in fields(DiscoverySettings) if field.name not in _OWN}
_SYNC = {field.name for field in fields(SyncLists)}
_NO_EFFECT = ("resync_on_reconnect", "resync_on_reconnect_timeout", "sync_topics_on_demand")
"""Parameters of master_sync that ours does not need: it always syncs again."""
_WRITTEN = frozenset(name.removeprefix("~") for name in (URI_PARAMETER, RECORD))
"""What the nodes write among their own parameters. It stays at the master when they are killed."""


def master_discovery() -> int:
    """Run the node ``master_discovery``; return the program's exit code."""
    return _run("master_discovery", _discover)


def master_sync() -> int:
    """Run the node ``master_sync``; return the program's exit code."""
    return _run("master_sync", _sync)


def discovery_settings(
    values: Mapping[str, Any], *, master_uri: str = "", node_name: str = "master_discovery"
) -> DiscoverySettings:
    """Return the settings of a discovery.

    Args:
        values: fkie's private parameters.
        master_uri: The master.
        node_name: The node's name, without namespace.

    Raises:
        MultimasterError: The value of a parameter is of another type.
        ValueError: A value is out of range.
    """
    chosen: dict[str, Any] = {}
    for name, value in values.items():
        if name not in _DISCOVERY:
            _warn("master_discovery", name, _DISCOVERY)
        elif name == "robot_hosts":
            chosen[name] = tuple(map(str, names(value)))
        else:
            chosen[name] = _checked(name, value)
    return DiscoverySettings(master_uri=master_uri, node_name=node_name, **chosen)


def sync_lists(values: Mapping[str, Any]) -> SyncLists:
    """Return the lists of a synchronization.

    Args:
        values: fkie's private parameters.

    Raises:
        MultimasterError: The interface file cannot be read.
    """
    options: dict[str, list[Any]] = {}
    file: Path | None = None
    is_remote = False
    for name, value in values.items():
        match name:
            case "interface_url":
                file = _interface_file(str(value))
            case "sync_remote_nodes":
                is_remote = bool(value)
            case _ if name in _SYNC:
                options[name] = names(value)
            case _ if name in _NO_EFFECT:
                pass
            case _:
                _warn("master_sync", name, {"interface_url", *_SYNC, *_NO_EFFECT})
    lists = read_lists(file, options)
    lists.sync_remote_nodes = lists.sync_remote_nodes or is_remote
    return lists


def names(value: Any) -> list[Any]:
    """Return the patterns of a parameter: a list, or the text of one, as a shell or a launch file leaves it.

    >>> names("[/a, '/b*', *]")
    ['/a', '/b*', '*']
    """
    if isinstance(value, list):
        return value
    text = str(value).strip().removeprefix("[").removesuffix("]")
    return [name for part in text.split(",") if (name := part.strip().strip("'\""))]


def _warn(node: str, name: str, known: Iterable[str]) -> None:
    _log.warning(
        "~%s is not a parameter of %s and has no effect; known are %s", name, node, ", ".join(sorted(known))
    )


def _checked(name: str, value: Any) -> Any:
    kind = str(_DISCOVERY[name])
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    fits = {
        "str": isinstance(value, str),
        "bool": isinstance(value, bool),
        "int": is_number and float(value).is_integer(),
        "float": is_number,
    }[kind]
    if not fits:
        raise MultimasterError(f"~{name} must be of type {kind}, not {value!r}")
    return int(value) if kind == "int" else value


def _interface_file(url: str) -> Path | None:
    if url in ("", "."):  # fkie's default: a file of the host, if there is one
        return None
    parts = urlsplit(url)
    if parts.scheme not in ("", "file"):
        raise MultimasterError(f"~interface_url must be a file, not {url}")
    return Path(parts.path)


def _run(name: str, serve: Callable[[Sequence[str]], Coroutine[Any, Any, int]]) -> int:
    try:
        return run(serve(sys.argv[1:]))
    except (RosError, ValueError) as error:
        print(f"{name}: {error}", file=sys.stderr)  # noqa: T201
    except OSError as error:
        print(f"{name}: cannot listen: {error.strerror or error}", file=sys.stderr)  # noqa: T201
    except KeyboardInterrupt:
        return 0
    return 1


async def _discover(argv: Sequence[str]) -> int:
    settings, values = await private_parameters("master_discovery", argv)
    await run_discovery(
        discovery_settings(values, master_uri=settings.master_uri, node_name=_base_name(settings))
    )
    return 0


async def _sync(argv: Sequence[str]) -> int:
    settings, values = await private_parameters("master_sync", argv)
    lists = sync_lists(values)
    await run_sync(SyncSettings(settings.master_uri, node_name=_base_name(settings), lists=lists))
    return 0


def _base_name(settings: NodeSettings) -> str:
    return settings.resolver.node_name.rpartition("/")[2]


async def private_parameters(name: str, argv: Sequence[str]) -> tuple[NodeSettings, dict[str, Any]]:
    """Return a node's settings and the private parameters that a user set, once its master answers.

    Args:
        name: The node's name, unless ``__name:=`` gives another one.
        argv: Its command line.

    Raises:
        MasterError: The master refuses a request.
        ValueError: An argument is not for a node.
    """
    if rest := parse_arguments(argv).rest:
        raise ValueError(f"arguments are parameters such as _name:=value; found {' '.join(rest)}")
    settings = NodeSettings.gather(name, namespace="", argv=argv, environ=os.environ)
    node = settings.resolver.node_name
    found: Any = {}
    async with RpcClient() as rpc:
        master = MasterClient(local_master(settings.master_uri), node, "", rpc)
        while True:
            try:
                for key, value in settings.parameters.items():
                    await master.call("setParam", f"{node}/{key}", value)
                found = await master.call("getParam", node)
                break
            except MasterRefusedError:  # it has no parameter of this node
                break
            except MasterUnreachableError:
                await asyncio.sleep(MASTER_POLL)
    stored = found if isinstance(found, dict) else {}
    given = {key: value for key, value in stored.items() if key not in _WRITTEN}
    return settings, {**given, **settings.parameters}
