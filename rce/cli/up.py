"""``rce up``: a whole engine in one terminal, with one process per task set."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from typing import Annotated, Any

import typer
from msgspec.structs import replace

from rce.cli.replicas import Replicas, ReplicasError
from rce.cli.settings import SettingsOptions
from rce.config import (
    EngineSettings,
    EtcdAddress,
    MasterSettings,
    SettingError,
    as_document,
    fields_of,
    read_store_address,
)
from rce.own_process import machine_memory
from rce.supervision.plan import Plan, Program
from rce.tls.choice import WARNED_VARIABLE, TlsChoice

OPTIONS = SettingsOptions(
    "dev", "state_dir", "secret_file", "log_level", "log_dir", "master", "robot", "container", "tls", up=True
)
SHARED = (
    "encodings.idna",
    "logging",
    "rce.config.loading",
    "rce.config.logs",
    "rce.config.secret",
    "rce.control_channel.channel",
    "rce.link.hub",
    "rce.ros.packages",
    "rce.own_process",
    "rce.tls.choice",
    "uvloop",
    "websockets.asyncio.server",
)
"""Modules that the task sets load, and the master in part; they are in memory once."""
ROBOT_LINK_PORT, CONTAINER_LINK_PORT = 10030, 10031


@OPTIONS.given("rce up")
def up(
    settings: EngineSettings,
    bind: Annotated[
        str | None, typer.Option(metavar="HOST", help="Address that all programs listen on.")
    ] = None,
) -> None:
    """Run an engine: master, robot and container task sets."""
    try:
        plan(settings if bind is None else bound_to(bind, settings)).hand_over()
    except ReplicasError as error:
        raise typer.BadParameter(str(error)) from None
    except OSError as error:
        typer.echo(f"rce up: {error}", err=True)
        raise typer.Exit(1) from error


def bound_to(bind: str, settings: EngineSettings) -> EngineSettings:
    """Return the settings with every program listening on one address.

    Raises:
        typer.BadParameter: It is not an address.
    """
    try:
        host = fields_of(MasterSettings)["bind"].read(bind)
    except SettingError as error:
        raise typer.BadParameter(f"--bind {error}") from None
    return replace(
        settings,
        master=replace(settings.master, bind=host),
        robot=replace(settings.robot, bind=host),
        container=replace(settings.container, bind=host),
    )


def plan(settings: EngineSettings) -> Plan:
    """Return the programs to run and the lines to print.

    Args:
        settings: The engine's settings.

    Raises:
        ReplicasError: So many masters cannot be run.
        typer.BadParameter: The state is to be in etcd.
    """
    if isinstance(read_store_address(settings.master.store), EtcdAddress):
        raise typer.BadParameter(
            "rce up keeps the state on this machine; for a state in etcd start rce-master, rce-robot and"
            " rce-container by themselves (docs/how-to/three-masters.md)"
        )
    masters = None if settings.master.replicas == 1 else Replicas(settings)
    ready = [f"RCE ready: {settings.http_url if masters is None else masters.http_urls}"]
    certified = {}
    if settings.tls.enabled:
        ready.append(
            f"RCE authority (clients need this file): {settings.certificates.absolute()}/authority.pem"
        )
        certified = _document(settings)
    texts = (warning(settings), None if masters is None else masters.warning)
    return Plan(
        programs=tuple(programs(settings, masters)),
        shared=SHARED,
        ready=tuple(ready),
        warnings=tuple(f"[up] {text}" for text in texts if text),
        certified=certified,
    )


def warning(settings: EngineSettings) -> str | None:
    """Return the warnings for an engine that serves other machines without TLS."""
    hosts = settings.master.bind, settings.robot.bind, settings.container.bind
    return TlsChoice.of(settings).plain_warning("passwords and messages travel", *hosts)


def programs(settings: EngineSettings, masters: Replicas | None = None) -> Iterable[Program]:
    """Return the engine's programs in start order; each gets all settings as one document.

    Args:
        settings: The engine's settings.
        masters: Several masters in place of one.
    """
    document = _document(settings)
    if masters is None:
        yield _program("master", "rce_master", document)
    else:
        document["master_host"] = masters.master_host
        yield from masters.programs(document)
    robot = settings.robot
    if robot.count > 1:  # together they hold no more than one would
        memory = (robot.memory or machine_memory() // 2) // robot.count
        settings = replace(settings, robot=replace(robot, memory=memory))
    shared = _document(settings).get("robot", {})
    link_port = ROBOT_LINK_PORT if robot.link_port is None else robot.link_port
    for index in range(robot.count):
        ports = {"ws_port": _next(robot.ws_port, index), "link_port": _next(link_port, 2 * index)}
        own = document | {"robot": shared | ports}
        if index and settings.log_dir is not None:  # two programs cannot rotate one file
            own["log_dir"] = str(settings.log_dir.absolute() / f"robot{index + 1}")
        yield _program(f"robot{index + 1}" if robot.count > 1 else "robot", "rce_robot", own)
    if settings.container.link_port is None:
        document["container"] = document.get("container", {}) | {"link_port": CONTAINER_LINK_PORT}
    final = _program("container", "rce_container", document, "--end").argv
    yield dataclasses.replace(_program("container", "rce_container", document), final=final)


def _document(settings: EngineSettings) -> dict[str, Any]:
    return as_document(settings) | {
        "state_dir": str(settings.state_dir.absolute()),
        "master_host": settings.master_host or settings.near_host,
    }


def _next(port: int, offset: int) -> int:
    return port + offset if port else 0


def _program(name: str, module: str, document: dict[str, Any], *options: str) -> Program:
    words = ("--settings", json.dumps(document), *options)
    return Program.of(name, module, *words, env={WARNED_VARIABLE: "1"})
