"""The command line of ``rce-robot``."""

from __future__ import annotations

import typer

from rce.cli.options import Verbose
from rce.cli.settings import COMMON, SettingsOptions
from rce.config import EngineSettings
from rce_robot.program import run

OPTIONS = SettingsOptions(
    "robot", "master.control_port", "container.package_path", "tls", *COMMON, master=True
)
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
@OPTIONS.given("rce-robot")
def robot(engine: EngineSettings, *, verbose: Verbose = False) -> None:
    """Run a robot task set: the WebSocket endpoint of robots, next to the master at MASTER_IP."""
    raise typer.Exit(run(engine, verbose=verbose))
