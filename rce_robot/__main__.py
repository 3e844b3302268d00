"""The program ``rce-robot``: the robot task set."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer
import uvloop

from rce.config.exceptions import RunDirError, SecretError
from rce.config.secret import load_secret
from rce.guard.files import raise_file_limit
from rce.ros.tcpros.allocator import keep_large_blocks
from rce_robot.app import App
from rce_robot.settings import RobotSettings

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

_DEFAULTS = RobotSettings()
_LOOPBACK = "127.0.0.1"


@app.command()
def robot(
    master: Annotated[str, typer.Argument(metavar="MASTER_IP", help="Host or address of the master.")],
    control_port: Annotated[int, typer.Option(help="The master's port for task sets.")] = 8080,
    ws_port: Annotated[int, typer.Option(help="Port that robots connect to; 0 takes a free one.")] = 9010,
    link_port: Annotated[
        int | None,
        typer.Option(help="Port for data links; 0 takes a free one [default: 10030, or a free one]"),
    ] = None,
    bind: Annotated[str, typer.Option(help="Address to listen on [default: all]")] = "",
    public_host: Annotated[
        str, typer.Option(help="Name or address of this machine for others [default: found out]")
    ] = "",
    public_url: Annotated[
        str, typer.Option(help="WebSocket URL that robots are sent to, if it is another.")
    ] = "",
    machine: Annotated[str, typer.Option(help="Name of this machine [default: its host name]")] = "",
    package_path: Annotated[
        list[Path] | None, typer.Option(help="Folder with packages that define messages; may be repeated.")
    ] = None,
    secret_file: Annotated[Path | None, typer.Option(help="File with the engine's shared secret.")] = None,
    origin: Annotated[
        list[str] | None, typer.Option(help="Origin of web pages that may connect; may be repeated.")
    ] = None,
    dev: Annotated[bool, typer.Option("--dev", help="Loopback only, with the development secret.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log more.")] = False,
) -> None:
    """Run a robot task set: the WebSocket endpoint of robots, next to the master at MASTER_IP."""
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    logging.getLogger("websockets").setLevel(logging.WARNING)
    settings = RobotSettings(
        host=bind or (_LOOPBACK if dev else _DEFAULTS.host),
        ws_port=ws_port,
        link_port=link_port,
        public_host=public_host,
        public_url=public_url,
        machine=machine,
        origins=tuple(origin or ()),
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
