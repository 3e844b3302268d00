"""``rce up``: a whole engine in one terminal, each task set a process of its own."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import signal
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
import uvloop

from rce.config.exceptions import ConfigError
from rce.config.settings import ContainerSettings, EngineSettings, Runtime, load_settings
from rce.supervision.supervisor import Program, StartError, Supervisor


def up(
    config: Annotated[
        Path | None, typer.Argument(help="Settings (YAML); see configs/engine.yaml.", show_default=False)
    ] = None,
    dev: Annotated[bool, typer.Option("--dev", help="Loopback only, user testUser/testUser.")] = False,
    state_dir: Annotated[Path | None, typer.Option(help="Where everything is kept.")] = None,
    http_port: Annotated[int | None, typer.Option(help="Clients and REST [9000].")] = None,
    control_port: Annotated[int | None, typer.Option(help="Task sets [8080].")] = None,
    ws_port: Annotated[int | None, typer.Option(help="Robots' WebSockets [9010].")] = None,
    robot_link_port: Annotated[int | None, typer.Option(help="Links to robot endpoints [10030].")] = None,
    container_link_port: Annotated[int | None, typer.Option(help="Links to containers [10031].")] = None,
    runtime: Annotated[Runtime | None, typer.Option(help="How containers are isolated [auto].")] = None,
    robots: Annotated[int | None, typer.Option(help="Number of robot processes [1].")] = None,
    package_path: Annotated[list[Path] | None, typer.Option(help="Folder with ROS packages.")] = None,
) -> None:
    """Run master, robot and container task sets; restart one that dies; stop all on Ctrl-C."""
    try:
        settings = load_settings(config)
    except ConfigError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from None
    settings = _override(
        settings,
        own={"state_dir": state_dir},
        master={"http_port": http_port, "control_port": control_port},
        robot={"ws_port": ws_port, "link_port": robot_link_port, "count": robots},
        container={
            "link_port": container_link_port,
            "runtime": runtime,
            "package_path": tuple(path.absolute() for path in package_path) if package_path else None,
        },
    )
    if dev:
        settings = settings.for_development()
    raise typer.Exit(uvloop.run(run(settings)))


def _override(settings: EngineSettings, own: dict[str, Any], **sections: dict[str, Any]) -> EngineSettings:
    """Put what the command line says over what the file says."""

    def given(values: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in values.items() if value is not None}

    changed = {
        name: getattr(settings, name).model_copy(update=given(values)) for name, values in sections.items()
    }
    return settings.model_copy(update={**given(own), **changed})


async def run(settings: EngineSettings) -> int:
    """Run an engine until SIGINT or SIGTERM; returns the exit code."""
    task = asyncio.current_task()
    assert task is not None
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)

    def announce() -> None:
        typer.echo(f"RCE ready: {master_url(settings)}")

    supervisor = Supervisor(list(programs(settings)), typer.echo)
    faults: tuple[BaseException, ...] = ()
    with contextlib.suppress(asyncio.CancelledError):
        try:
            await supervisor.run(announce)
        except* (StartError, OSError) as group:
            faults = group.exceptions
    for fault in faults:
        typer.echo(f"rce up: {fault}", err=True)
    return 1 if faults else 0


def master_url(settings: EngineSettings) -> str:
    """Where clients on this machine find the master."""
    host = settings.master.bind
    with contextlib.suppress(ValueError):
        if ipaddress.ip_address(host).is_unspecified:
            host = "127.0.0.1"
    return f"http://{host}:{settings.master.http_port}/"


def programs(settings: EngineSettings) -> Iterable[Program]:
    """The programs of an engine, in the order in which they start."""
    common = _options({"secret-file": settings.secret_file}) + (["--dev"] if settings.dev else [])
    control = _options({"control-port": settings.master.control_port})
    state = settings.state_dir.absolute()
    yield _program(
        "master",
        "rce_master",
        *_options({"bind": settings.master.bind, "http-port": settings.master.http_port}),
        *_options({"state-dir": state / "master", "robot-grace": settings.master.robot_grace}),
        *_options({"container-grace": settings.master.container_grace}),
        *_options({"token-lifetime": settings.master.token_lifetime}),
        *_repeat("trusted-proxy", settings.master.trusted_proxies),
        *_options({"max-slots": settings.master.max_slots, "max-cpu": settings.master.max_cpu}),
        *_options({"max-memory": f"{settings.master.max_memory}B"}),
        *(control + common),
    )
    packages = _repeat("package-path", settings.container.package_path)
    for index in range(settings.robot.count):
        yield _program(
            f"robot{index + 1}" if settings.robot.count > 1 else "robot",
            "rce_robot",
            settings.master_host,
            *_options({"bind": settings.robot.bind, "ws-port": _next(settings.robot.ws_port, index)}),
            *_options({"link-port": _next(settings.robot.link_port, 2 * index)}),
            *_options({"public-host": settings.robot.public_host, "public-url": settings.robot.public_url}),
            *_repeat("origin", settings.robot.origins),
            *_repeat("trusted-proxy", settings.robot.trusted_proxies),
            *_options(
                {"user-memory": settings.robot.user_memory >> 20, "memory": settings.robot.memory >> 20}
            ),
            *_options({"strangers": settings.robot.strangers}),
            *(packages + control + common),
        )
    yield _program(
        "container",
        "rce_container",
        settings.master_host,
        *_options({"bind": settings.container.bind, "link-port": settings.container.link_port}),
        *_options({"state-dir": state / "container", "runtime": settings.container.runtime.value}),
        *_options({"grace": settings.container.grace}),
        *_repeat("label", settings.container.labels),
        *_repeat("image", settings.container.images),
        *_options(_sizes(settings.container)),
        *(("--allow-requirements",) if settings.container.allow_requirements else ()),
        *_joined({"pip-args": settings.container.pip_args}),
        *(packages + control + common),
    )


def _sizes(container: ContainerSettings) -> dict[str, Any]:
    """What containers and their machine have: options of ``rce-container``, memory and disk in MB."""
    plain = ("slots", "slot_processes", "first_uid", "uids", "log_days")
    amounts = ("slot_memory", "home_size", "log_space", "bundle_space")
    values = {name: getattr(container, name) for name in plain}
    values |= {name: getattr(container, name) >> 20 for name in amounts}
    return {name.replace("_", "-"): value for name, value in values.items()}


def _next(port: int, offset: int) -> int:
    return port + offset if port else 0


def _options(values: dict[str, Any]) -> list[str]:
    given = {name: value for name, value in values.items() if value not in (None, "")}
    return [text for name, value in given.items() for text in (f"--{name}", str(value))]


def _joined(values: dict[str, str]) -> list[str]:
    """Options whose values may begin with a dash."""
    return [f"--{name}={value}" for name, value in values.items() if value]


def _repeat(name: str, values: Iterable[object]) -> list[str]:
    return [text for value in values for text in (f"--{name}", str(value))]


def _program(name: str, module: str, *arguments: str) -> Program:
    return Program(name, [sys.executable, "-m", module, *arguments])
