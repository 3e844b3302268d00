"""``rce backup`` and ``rce restore``."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from msgspec import structs

from rce.config import ConfigError, EngineSettings, EtcdAddress, load_settings, read_store_address
from rce.model import about
from rce.tls.choice import TlsChoice
from rce_master.backup import CERTIFICATES, MASTER, Copy, back_up, restore
from rce_master.cli.exceptions import CliError
from rce_master.cli.offline import certificates_of, find_folder, find_state, give_to_owner, read_etcd
from rce_master.etcd_backup import exported, restore_to_etcd
from rce_master.exceptions import StoreError

Config = Annotated[Path | None, typer.Option(metavar="FILE", help="Settings file: says where the state is.")]
StateDir = Annotated[
    Path | None, typer.Option(metavar="PATH", help="State folder of the engine, or of rce-master.")
]


StoreOption = Annotated[
    str,
    typer.Option(
        metavar="etcd://HOST:2379,...",
        help="The state is in this etcd; default: see the settings file.",
    ),
]


def backup(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to make (tar).")],
    config: Config = None,
    state_dir: StateDir = None,
    store: StoreOption = "",
) -> None:
    """Copy the master's state to a file, also while it runs."""
    place = _place(config, state_dir, store)
    try:
        export = None if place.etcd is None else partial(exported, place.etcd, place.tls)
        made = back_up(place.folders, file, export)
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
    store: StoreOption = "",
) -> None:
    """Restore a backup while no master uses the folder, or leads."""
    place = _place(config, state_dir, store)
    if place.etcd is not None and replace_:
        text = "--replace is for folders; restore to an empty prefix: etcd://HOST:2379/PREFIX"
        typer.echo(f"rce restore: {text}", err=True)
        raise typer.Exit(2)
    target: Path | EtcdAddress = place.folders[MASTER]
    aside: list[Path] = []
    try:
        if place.etcd is None:
            found, aside = restore(file, place.folders, replace=replace_)
        else:
            target = place.etcd
            found = restore_to_etcd(file, place.folders[MASTER], place.etcd, place.tls)
    except StoreError as error:
        typer.echo(f"rce restore: {error}", err=True)
        raise typer.Exit(1) from None
    finally:
        give_to_owner(place.folders[MASTER])
    made = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(found.created))
    typer.echo(f"restored {target} as of {made}: {_about(found)}")
    for folder in aside:
        typer.echo(f"the former state is in {folder}")
    if place.etcd is not None:
        typer.echo(
            f"archives of packages are in {place.folders[MASTER]}: start the master of this machine too, the"
            " others get them from it; certificates and the audit log stay in the file"
        )


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a state is."""

    folders: dict[str, Path]
    etcd: EtcdAddress | None
    tls: TlsChoice


def _about(copy: Copy) -> str:
    return f"{copy.files} files, {about(copy.size)}"


def _place(config: Path | None, state_dir: Path | None, store: str) -> _Place:
    """Find the state: with a folder and no ``--store``, it is not in etcd whatever the settings say."""
    try:
        settings = load_settings(config)
        tls = TlsChoice.of(settings)
    except ConfigError as error:
        typer.echo(error, err=True)
        raise typer.Exit(2) from None
    address: object = None
    if store:
        try:
            address = read_etcd(store)
        except CliError as error:
            typer.echo(error, err=True)
            raise typer.Exit(2) from None
    elif state_dir is None:
        address = read_store_address(settings.master.store)
    etcd = address if isinstance(address, EtcdAddress) else None
    if etcd is not None and state_dir is not None:
        master = find_folder(state_dir.absolute())
        certificates = certificates_of(master, settings)
        folders = {MASTER: master, CERTIFICATES: certificates}
        return _Place(folders, etcd, replace(tls, folder=certificates))
    return _Place(_folders(settings, state_dir), etcd, tls)


def _folders(settings: EngineSettings, state_dir: Path | None) -> dict[str, Path]:
    """Find the folders of the state."""
    if state_dir is None:
        return {MASTER: settings.master_state, CERTIFICATES: settings.certificates}
    try:
        folder = find_state(state_dir.absolute())
    except CliError as error:
        typer.echo(error, err=True)
        raise typer.Exit(1) from None
    if folder == state_dir.absolute():
        return {MASTER: folder}  # a folder that `rce-master --state-dir` was given
    return {MASTER: folder, CERTIFICATES: structs.replace(settings, state_dir=folder.parent).certificates}
