"""``rce secret``: the secret that the engine's programs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rce.config.exceptions import SecretError
from rce.config.secret import default_secret_file, new_secret

app = typer.Typer(no_args_is_help=True, help="Make the secret that the engine's programs share.")


@app.callback()
def _group() -> None:
    """Make the secret that the engine's programs share."""


@app.command("new")
def new(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="Where to keep it (default: where it is looked for)")
    ] = None,
) -> None:
    """Make a secret in a file that only its owner can read."""
    path = (file or default_secret_file()).expanduser()
    try:
        new_secret(path)
    except SecretError as error:
        typer.echo(f"rce secret new: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(f"made {path}")
    if file is not None:
        typer.echo(f"programs find it by --secret-file {path}, or RCE_SECRET_FILE={path}")
    typer.echo("copy it to every machine of the engine, and to nobody else")
