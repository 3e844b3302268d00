"""The command line of ``rce-container``."""

from __future__ import annotations

from typing import Annotated

import typer

from rce.cli.options import Verbose
from rce.cli.settings import COMMON, SettingsOptions
from rce.config import EngineSettings
from rce_container.program import run

TLS = ("tls.enabled", "tls.certificates", "tls.name")
OPTIONS = SettingsOptions("container", "master.control_port", *TLS, *COMMON, master=True)
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
@OPTIONS.given("rce-container")
def container(
    engine: EngineSettings,
    *,
    end: Annotated[
        bool, typer.Option("--end", help="End the containers that a killed rce-container left, and stop.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Check settings, secret and certificates, and stop.")
    ] = False,
    verbose: Verbose = False,
) -> None:
    """Run a container task set: makes the containers of the master at MASTER_IP on this machine."""
    raise typer.Exit(run(engine, end=end, check=check, verbose=verbose))
