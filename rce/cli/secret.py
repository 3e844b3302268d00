"""``rce secret``: the secret that the engine's programs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rce.config.exceptions import SecretError
from rce.config.secret import default_secret_file, new_secret, retire_secrets, rotate_secret

app = typer.Typer(no_args_is_help=True, help="Make and change the secret that the engine's programs share.")

File = Annotated[
    Path | None, typer.Argument(metavar="FILE", help="Where it is (default: where it is looked for)")
]


@app.callback()
def _group() -> None:
    """Make and change the secret that the engine's programs share."""


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
    typer.echo("copy it to every machine of the engine, and nowhere else")


@app.command("rotate")
def rotate(file: File = None) -> None:
    """Make a new secret; the old one stays accepted until it is retired."""
    path = (file or default_secret_file()).expanduser()
    try:
        rotate_secret(path)
    except SecretError as error:
        typer.echo(f"rce secret rotate: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(f"{path} has a new secret; the old one is accepted, too. Programs read it while they run")
    typer.echo("copy it to every machine of the engine, then run there: rce secret retire")


@app.command("retire")
def retire(file: File = None) -> None:
    """Remove the old secret; task sets that showed it must show the new one."""
    path = (file or default_secret_file()).expanduser()
    try:
        number = retire_secrets(path)
    except SecretError as error:
        typer.echo(f"rce secret retire: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(f"{path} has the new secret only" if number else f"{path} has one secret only; nothing to do")
