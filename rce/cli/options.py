"""What the command lines of the task sets have in common, and how a settings file stands behind them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from rce.config.exceptions import ConfigError

if TYPE_CHECKING:
    from rce.config.settings import EngineSettings

LOOPBACK = "127.0.0.1"

MasterHost = Annotated[str, typer.Argument(metavar="MASTER_IP", help="Host or address of the master.")]
ControlPort = Annotated[int, typer.Option(help="The master's port for task sets.")]
LinkPort = Annotated[
    int | None, typer.Option(help="Port for data links; 0 takes a free one (default: 10030, or a free one)")
]
Machine = Annotated[str, typer.Option(help="Name of this machine (default: its host name)")]
SecretFile = Annotated[Path | None, typer.Option(help="File with the engine's shared secret.")]
Development = Annotated[bool, typer.Option("--dev", help="Loopback only, with the development secret.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log more.")]

Picker: TypeAlias = Callable[["EngineSettings"], dict[str, Any]]
"""Says which of the engine's settings, if they were set, are which parameters of a program."""


def config_option(pick: Picker) -> Any:
    """Return the option ``--config``: a file of engine settings, over which the command line wins."""

    def read(context: typer.Context, path: Path | None) -> Path | None:
        if path is not None:
            from rce.config.settings import load_settings  # its models cost every program 15 MB

            try:
                settings = load_settings(path)
            except ConfigError as error:
                typer.echo(error, err=True)
                raise typer.Exit(2) from error
            context.default_map = shared(settings) | pick(settings)
        return path

    return typer.Option(callback=read, is_eager=True, help="Engine settings (YAML); options win.")


def shared(settings: EngineSettings) -> dict[str, Any]:
    """Return what every task set takes of a file: where the master is, and the secret."""
    own = chosen(settings, {"master_host": "master", "secret_file": "secret_file", "dev": "dev"})
    return own | chosen(settings.master, {"control_port": "control_port"})


def chosen(section: Any, names: dict[str, str]) -> dict[str, Any]:
    """Return those settings of a section that the file holds, under the names of a program's parameters."""
    return {names[name]: getattr(section, name) for name in names if name in section.model_fields_set}


def start_logging(*, verbose: bool) -> None:
    """Log to the standard error stream as all programs of the engine do."""
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it would tell the secret
