"""``rce master``: the state of masters that do not run, moved from one store to another."""

from __future__ import annotations

from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rce.config import (
    STORE_FILE,
    ConfigError,
    EtcdAddress,
    default_state_dir,
    load_settings,
    read_store_address,
)
from rce.tls.choice import TlsChoice
from rce_master.cli.client import run
from rce_master.cli.exceptions import CliError
from rce_master.cli.offline import certificates_of, find_folder, find_state, give_to_owner, open_store
from rce_master.exceptions import StoreBusyError
from rce_master.packages.carrying import carry, packages_of, states_of
from rce_master.snapshots.carrying import carry_snapshots
from rce_master.snapshots.service import SNAPSHOTS
from rce_master.state_service import load_converted
from rce_master.store.copying import copy_rows

_ADDRESS = "sqlite:FOLDER|etcd://HOST:2379,..."

app = typer.Typer(no_args_is_help=True, help="Move the state of the master to another store.")


@app.callback()
def _root() -> None:
    """Make typer ask for a command, though there is only one."""


@app.command("copy")
def copy(
    source: Annotated[str, typer.Option("--from", metavar=_ADDRESS, help="The store that is copied.")],
    target: Annotated[str, typer.Option("--to", metavar=_ADDRESS, help="The store that is filled.")],
    state_dir: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="State folder of this machine's master on etcd: holds packages and snapshots.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings file: names that folder, and certificates.")
    ] = None,
) -> None:
    """Copy the state of a master to an empty store, while no master runs on either."""
    run(_copy(source, target, None if state_dir is None else find_folder(state_dir.absolute()), config))


async def _copy(source: str, target: str, state_dir: Path | None, config: Path | None) -> None:
    here, there = _read(source, "--from"), _read(target, "--to")
    if here == there:
        raise CliError("--from and --to name the same store")
    if not isinstance(here, EtcdAddress) and not (here / STORE_FILE).exists():
        raise CliError(f"--from names {here}, which holds no state: it has no {STORE_FILE}")
    try:
        settings = load_settings(config)
    except ConfigError as error:
        raise CliError(str(error)) from error
    tls = TlsChoice.of(settings)
    if state_dir is not None:
        tls = replace(tls, folder=certificates_of(state_dir, settings))
    beside_etcd = settings.master_state if state_dir is None else state_dir
    folder, new_folder = (beside_etcd if isinstance(one, EtcdAddress) else one for one in (here, there))
    async with AsyncExitStack() as stack:
        stack.callback(give_to_owner, new_folder)
        try:
            old = await stack.enter_async_context(open_store(here, tls))
            term = await old.begin_term()
            new = await stack.enter_async_context(open_store(there, tls))
            snapshot = await load_converted(old, term)
            archives = carry([*packages_of(snapshot), *states_of(snapshot)], folder, new_folder)
            snapshot, lost = carry_snapshots(snapshot, folder, new_folder)
            count = await copy_rows(snapshot, new, above=term)
        except StoreBusyError as error:
            raise CliError(f"{error}; the state is copied while no master runs") from error
    typer.echo(f"copied {count} records to {there}; start no master on {here} any more")
    for volume in lost:
        typer.echo(
            f"volume {volume} is copied without its snapshot: parts of it in {folder / SNAPSHOTS} are missing"
            " or damaged; if another master has it, empty the target, and copy with its state folder",
            err=True,
        )
    if isinstance(there, EtcdAddress) and (archives or (new_folder / SNAPSHOTS).exists()):
        typer.echo(
            f"{archives} packages and states of nodes, and snapshots of volumes, are in {new_folder}: start a"
            f" master of this machine on that folder (--state-dir {new_folder}); the others get them from it"
        )


def _read(text: str, option: str) -> Path | EtcdAddress:
    """Read the address of a store; return its folder, or that of etcd."""
    try:
        address = read_store_address(text)
    except ValueError as error:
        raise CliError(f"{option} {error}") from None
    if isinstance(address, EtcdAddress):
        return address
    return find_state((address.folder or default_state_dir()).absolute())
