"""``rce backup`` and ``rce restore``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace

from rce.config import ConfigError, load_settings
from rce.model import about
from rce_master.backup import CERTIFICATES, MASTER, Copy, back_up, restore
from rce_master.cli.exceptions import CliError
from rce_master.cli.offline import find_state
from rce_master.exceptions import StoreError

Config = Annotated[Path | None, typer.Option(metavar="FILE", help="Settings file: says where the state is.")]
StateDir = Annotated[
    Path | None, typer.Option(metavar="PATH", help="State folder of the engine, or of rce-master.")
]


def backup(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to make (tar).")],
    config: Config = None,
    state_dir: StateDir = None,
) -> None:
    """Copy the master's state to a file, also while it runs."""
    try:
        made = back_up(_folders(config, state_dir), file)
    except StoreError as error:
        typer.echo(f"rce backup: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(f"made {file}: {_about(made)}; keep it safe, it holds keys and password hashes")


def restore_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A file that rce backup made.")],
    config: Config = None,
    state_dir: StateDir = None,
    replace_: Annotated[
        bool, typer.Option("--replace", help="Move existing state aside and replace it.")
    ] = False,
) -> None:
    """Restore a backup while no master uses the folder."""
    folders = _folders(config, state_dir)
    try:
        found, aside = restore(file, folders, replace=replace_)
    except StoreError as error:
        typer.echo(f"rce restore: {error}", err=True)
        raise typer.Exit(1) from None
    made = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(found.created))
    typer.echo(f"restored {folders[MASTER]} as of {made}: {_about(found)}")
    for folder in aside:
        typer.echo(f"the former state is in {folder}")


def _about(copy: Copy) -> str:
    return f"{copy.files} files, {about(copy.size)}"


def _folders(config: Path | None, state_dir: Path | None) -> dict[str, Path]:
    """Find the folders of the state."""
    try:
        settings = load_settings(config)
    except ConfigError as error:
        typer.echo(error, err=True)
        raise typer.Exit(2) from None
    if state_dir is None:
        return {MASTER: settings.master_state, CERTIFICATES: settings.certificates}
    try:
        folder = find_state(state_dir.absolute())
    except CliError as error:
        typer.echo(error, err=True)
        raise typer.Exit(1) from None
    if folder == state_dir.absolute():
        return {MASTER: folder}  # a folder that `rce-master --state-dir` was given
    return {MASTER: folder, CERTIFICATES: replace(settings, state_dir=folder.parent).certificates}
