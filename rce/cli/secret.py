"""``rce secret``: the secret that the engine's programs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rce.config import SecretError, default_secret_file, new_secret, retire_secrets, rotate_secret

app = typer.Typer(no_args_is_help=True, help="Create or change the secret of the engine's programs.")

File = Annotated[
    Path | None,
    typer.Argument(metavar="FILE", help="File of the secret (default: where the programs look for it)"),
]


@app.callback()
def _group() -> None:
    """Create or change the secret of the engine's programs."""


@app.command("new")
def new(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="File to write it to (default: where the programs look for it)"),
    ] = None,
) -> None:
    """Create a secret in a file that only its owner can read."""
    path = (file or default_secret_file()).expanduser()
    try:
        new_secret(path)
    except SecretError as error:
        typer.echo(f"rce secret new: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(f"made {path}")
    if file is not None:
        typer.echo(f"give it to programs with --secret-file {path} or RCE_SECRET_FILE={path}")
    typer.echo("copy it to every machine of the engine, and to no other")


@app.command("rotate")
def rotate(file: File = None) -> None:
    """Create a new secret; the old one is accepted until it is retired."""
    path = (file or default_secret_file()).expanduser()
    try:
        rotate_secret(path)
    except SecretError as error:
        typer.echo(f"rce secret rotate: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(f"{path} has a new secret; the old one is still accepted. Running programs reload it")
    typer.echo("copy it to every machine of the engine, then run there: rce secret retire")


@app.command("retire")
def retire(file: File = None) -> None:
    """Remove the old secret; task sets must use the new one."""
    path = (file or default_secret_file()).expanduser()
    try:
        number = retire_secrets(path)
    except SecretError as error:
        typer.echo(f"rce secret retire: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(
        f"{path} has only the new secret now" if number else f"{path} has only one secret; nothing to do"
    )
