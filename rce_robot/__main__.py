"""The program ``rce-robot``: the robot task set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import uvloop

from rce.cli.options import (
    LOOPBACK,
    ControlPort,
    Development,
    LinkPort,
    Machine,
    MasterHost,
    SecretFile,
    Verbose,
    chosen,
    config_option,
    start_logging,
)
from rce.config.exceptions import RunDirError, SecretError
from rce.config.secret import load_secret
from rce.control.limits import MEGABYTE
from rce.guard.files import raise_file_limit
from rce.ros.tcpros.allocator import keep_large_blocks
from rce_robot.app import App
from rce_robot.settings import RobotSettings

if TYPE_CHECKING:
    from rce.config.settings import EngineSettings

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

_DEFAULTS = RobotSettings()


def _pick(settings: EngineSettings) -> dict[str, Any]:
    """Say which settings of a file are which parameters here."""
    names = ("bind", "ws_port", "link_port", "public_host", "public_url")
    sizes = {"user_memory": "user_memory", "memory": "memory"}
    return {
        **chosen(settings.robot, {name: name for name in names}),
        **chosen(
            settings.robot,
            {"origins": "origin", "strangers": "strangers", "trusted_proxies": "trusted_proxy"},
        ),
        **{name: size // MEGABYTE for name, size in chosen(settings.robot, sizes).items()},
        **chosen(settings.container, {"package_path": "package_path"}),
    }


@app.command()
def robot(
    master: MasterHost,
    control_port: ControlPort = 8080,
    ws_port: Annotated[int, typer.Option(help="Port that robots connect to; 0 takes a free one.")] = 9010,
    link_port: LinkPort = None,
    bind: Annotated[str, typer.Option(help="Address to listen on (default: all)")] = "",
    public_host: Annotated[
        str, typer.Option(help="Name or address of this machine for others (default: found out)")
    ] = "",
    public_url: Annotated[
        str, typer.Option(help="WebSocket URL that robots are sent to, if it is another.")
    ] = "",
    machine: Machine = "",
    package_path: Annotated[
        list[Path] | None, typer.Option(help="Folder with packages that define messages; may be repeated.")
    ] = None,
    secret_file: SecretFile = None,
    origin: Annotated[
        list[str] | None, typer.Option(help="Origin of web pages that may connect; may be repeated.")
    ] = None,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(help="Believe this proxy's (or network's) X-Forwarded-For; may be repeated."),
    ] = None,
    user_memory: Annotated[
        int,
        typer.Option(
            metavar="MB", help="What may wait for all robots of a user; over it the oldest goes.", min=1
        ),
    ] = _DEFAULTS.user_memory // MEGABYTE,
    memory: Annotated[
        int,
        typer.Option(metavar="MB", help="The same for all users (default: half of the machine's)", min=0),
    ] = 0,
    strangers: Annotated[
        int, typer.Option(help="Connections that have not logged in yet, from one address.", min=1)
    ] = _DEFAULTS.strangers_per_address,
    config: Annotated[Path | None, config_option(_pick)] = None,  # noqa: ARG001 - read before all others
    dev: Development = False,
    verbose: Verbose = False,
) -> None:
    """Run a robot task set: the WebSocket endpoint of robots, next to the master at MASTER_IP."""
    start_logging(verbose=verbose)
    settings = RobotSettings(
        host=bind or (LOOPBACK if dev else _DEFAULTS.host),
        ws_port=ws_port,
        link_port=link_port,
        public_host=public_host,
        public_url=public_url,
        machine=machine,
        origins=tuple(origin or ()),
        trusted_proxies=tuple(trusted_proxy or ()),
        user_memory=user_memory * MEGABYTE,
        memory=memory * MEGABYTE,
        strangers_per_address=strangers,
    )
    keep_large_blocks()
    raise_file_limit()
    try:
        secret = load_secret(secret_file, dev=dev)
        program = App(
            master=master,
            control_port=control_port,
            secret=secret,
            packages=package_path or (),
            settings=settings,
        )
        uvloop.run(program.run(_announce))
    except (SecretError, RunDirError, OSError) as error:
        typer.echo(f"rce-robot: {error}", err=True)
        raise typer.Exit(1) from error


def _announce(url: str) -> None:
    print(f"rce-robot ready: {url}", flush=True)  # noqa: T201 - what other programs wait for


def main() -> None:
    """Run the program."""
    app()


if __name__ == "__main__":
    main()
