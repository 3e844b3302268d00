"""The program ``rce-robot``: the robot task set."""

from __future__ import annotations

import typer
import uvloop

from rce.cli.options import Verbose, start_logging
from rce.cli.settings import COMMON, SettingsOptions
from rce.config.exceptions import RunDirError, SecretError
from rce.config.secret import load_secret
from rce.config.settings import EngineSettings
from rce.guard.files import raise_file_limit
from rce.ros.tcpros.allocator import keep_large_blocks
from rce.tls.choice import TlsChoice
from rce.tls.exceptions import CertificateError
from rce_robot.app import App
from rce_robot.settings import RobotSettings

OPTIONS = SettingsOptions(
    "robot", "master.control_port", "container.package_path", "tls", *COMMON, master=True
)
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
@OPTIONS.given("rce-robot")
def robot(engine: EngineSettings, *, verbose: Verbose = False) -> None:
    """Run a robot task set: the WebSocket endpoint of robots, next to the master at MASTER_IP."""
    start_logging(engine, "rce-robot", verbose=verbose)
    own = engine.robot
    settings = RobotSettings(
        host=own.bind,
        ws_port=own.ws_port,
        link_port=own.link_port,
        public_host=own.public_host,
        public_url=own.public_url,
        machine=engine.machine,
        origins=own.origins,
        trusted_proxies=own.trusted_proxies,
        user_memory=own.user_memory,
        memory=own.memory,
        strangers_per_address=own.strangers,
    )
    keep_large_blocks()
    raise_file_limit()
    try:
        secret = load_secret(engine.secret_file, dev=engine.dev)
        program = App(
            master=engine.master_host,
            control_port=engine.master.control_port,
            secret=secret,
            packages=engine.container.package_path,
            settings=settings,
            tls=TlsChoice.of(engine),
        )
        uvloop.run(program.run(_announce))
    except (SecretError, RunDirError, CertificateError, OSError) as error:
        typer.echo(f"rce-robot: {error}", err=True)
        raise typer.Exit(1) from error


def _announce(url: str) -> None:
    print(f"rce-robot ready: {url}", flush=True)  # noqa: T201 - what other programs wait for


def main() -> None:
    """Run the program."""
    app()


if __name__ == "__main__":
    main()
