"""The command line of ``rce-master``."""

from __future__ import annotations

import typer

from rce.cli.options import Verbose
from rce.cli.settings import COMMON, SettingsOptions
from rce.config import EngineSettings
from rce_master.program import run

OPTIONS = SettingsOptions("master", "tls", *COMMON)
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
@OPTIONS.given("rce-master")
def command(engine: EngineSettings, *, verbose: Verbose = False) -> None:
    """Run the Master Task Set: HTTP for clients on 9000, control of task sets on 8080."""
    raise typer.Exit(run(engine, verbose=verbose))
