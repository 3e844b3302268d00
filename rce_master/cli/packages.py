"""``rce package``: bring packages of nodes to an engine."""

from __future__ import annotations

import asyncio
import hashlib
import socket
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

import typer
from rich.console import Console

from rce.packages import BadArchiveError, SigningKey, key_id, statement
from rce.packages.folder import Source, look_into
from rce_master.cli import credentials, signing_key
from rce_master.cli.client import ApiClient, OfUser, OfUserByAdmin, of_user, run
from rce_master.cli.exceptions import CliError
from rce_master.cli.tables import TextTable

if TYPE_CHECKING:
    from rce_master.cli.credentials import Credentials

app = typer.Typer(no_args_is_help=True, help="Bring packages of nodes to an engine.")
keys = typer.Typer(help="The keys that sign packages: list, register, revoke.")
app.add_typer(keys, name="key")

_CHUNK = 1 << 20
_LISTED = 40
"""How many files of a package are shown, unless all are asked for."""


@app.command("push")
def push(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with package.yaml or package.xml.")],
    version: Annotated[str, typer.Option(help="Instead of the version in the manifest.")] = "",
    every: Annotated[bool, typer.Option("--all", help="List every file.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell what would be pushed.")] = False,
) -> None:
    """Pack a package's folder, sign it, and give it to the engine for your containers."""
    run(_push(folder, version, every=every, dry_run=dry_run))


async def _push(folder: Path, version: str, *, every: bool, dry_run: bool) -> None:
    try:
        source = look_into(folder, version)
        _tell(source, None if every else _LISTED)
        if dry_run:
            return
        login = credentials.load()
        with tempfile.TemporaryFile() as archive:
            source.pack(archive)
            async with ApiClient.of(login) as client:
                reply = await _send(client, login, source, archive)
    except BadArchiveError as error:
        faults = "".join(f"\n  {fault}" for fault in error.faults)
        raise CliError(f"{folder} cannot be pushed:{faults}") from error
    for warning in reply["warnings"]:
        typer.echo(f"warning: {warning}", err=True)
    name = f"{reply['name']}@{reply['version']}"
    typer.echo(f"pushed {name} ({_bytes(reply['packed'])}, sha256 {reply['sha256'][:16]})")
    names = f'"pkg": "{name}"' + (f' or "pkg": "{reply["name"]}"' if reply["newest"] else "")
    typer.echo(f"nodes get it by {names}")


async def _send(client: ApiClient, login: Credentials, source: Source, archive: BinaryIO) -> Any:
    name, version = source.contents.name, source.version
    key, _ = signing_key.load_or_make()
    known = await client.items("/package-keys", "keys")
    if all(one["key"] != key.public for one in known):
        if known:
            raise CliError(
                f"the key {signing_key.key_file()} is not registered with your account, which has other keys;"
                " if it is yours, run: rce package key register"
            )
        await _register(client, key)
    sha256 = await asyncio.to_thread(_sha256, archive)
    signature = key.sign(statement(login.user, name, version, sha256))
    archive.seek(0)
    query = {"key": key.public, "signature": signature}
    return await client.upload(f"/packages/{name}/{version}", archive, query)


def _sha256(archive: BinaryIO) -> str:
    archive.seek(0)
    digest = hashlib.sha256()
    while chunk := archive.read(_CHUNK):
        digest.update(chunk)
    return digest.hexdigest()


def _tell(source: Source, most: int | None) -> None:
    contents = source.contents
    entries = list(source.tree.entries.values())[1:]
    for entry in entries[:most]:
        mark = "*" if entry.executable else "/" if entry.kind.value == "folder" else ""
        link = f" -> {entry.target}" if entry.target else ""
        typer.echo(f"  {'/'.join(entry.parts[1:])}{mark}{link}")
    if most is not None and len(entries) > most:
        typer.echo(f"  ... and {len(entries) - most} more (--all lists them)")
    typer.echo(f"{contents.name} {source.version}: {contents.files} files, {_bytes(contents.size)}")
    if contents.executables:
        typer.echo(f"nodes: {', '.join(contents.executables)}")


@app.command("list")
def list_(user: OfUser = "") -> None:
    """List the versions of all packages."""
    run(_list(user))


async def _list(user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await client.items("/packages", query=of_user(user))
    table = TextTable("package", "version", "size", "pushed", "used by")
    for one in found:
        version = one["version"] + (" (newest)" if one["newest"] else "")
        table.add(_name(one, found), version, _bytes(one["packed"]), _when(one["created"]), _users(one))
    Console().print(table)


@app.command("show")
def show(
    name: Annotated[str, typer.Argument(help="Name of the package.")],
    version: Annotated[str, typer.Argument(help="(default: the newest)", show_default=False)] = "",
    user: OfUser = "",
) -> None:
    """Show a package."""
    run(_show(name, version, user))


async def _show(name: str, version: str, user: str) -> None:
    login = credentials.load()
    async with ApiClient.of(login) as client:
        found = await client.items("/packages", query=of_user(user or login.user))
    fitting = [one for one in found if one["name"] == name]
    fitting = [one for one in fitting if (one["version"] == version if version else one["newest"])]
    if not fitting:
        raise CliError(f"there is no package {name!r}{f' of version {version!r}' if version else ''}")
    (one,) = fitting
    table = TextTable(show_header=False)
    for key, value in (
        ("package", f"{one['name']}@{one['version']}" + (" (newest)" if one["newest"] else "")),
        ("description", one["description"] or "-"),
        ("nodes", ", ".join(one["executables"]) or "-"),
        ("requirements.txt", "yes" if one["requirements"] else "no"),
        ("files", f"{one['files']}, {_bytes(one['size'])}; archive {_bytes(one['packed'])}"),
        ("sha256", one["sha256"]),
        ("signed by", one["key"]),
        ("pushed", _when(one["created"])),
        ("used by", _users(one)),
    ):
        table.add(key, value)
    Console().print(table)


@app.command("remove")
def remove(
    name: Annotated[str, typer.Argument(help="Name of the package.")],
    version: Annotated[str, typer.Argument(help="Version of the package.")],
    user: OfUserByAdmin = "",
) -> None:
    """Remove a version that no node needs."""
    run(_remove(name, version, user))


async def _remove(name: str, version: str, user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        await client.call("DELETE", f"/packages/{name}/{version}", query=of_user(user))
    typer.echo(f"removed {name}@{version}")


@keys.callback(invoke_without_command=True)
def show_keys(context: typer.Context) -> None:
    """List your keys; the one that this machine signs with is marked."""
    if context.invoked_subcommand is None:
        run(_show_keys())


async def _show_keys() -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await client.items("/package-keys", "keys")
    own = signing_key.load()
    table = TextTable("key", "label", "since", "")
    for one in found:
        here = "this machine's" if own is not None and own.public == one["key"] else ""
        table.add(one["id"], one["label"] or "-", _when(one["created"]), here)
    Console().print(table)
    if own is not None and all(one["key"] != own.public for one in found):
        typer.echo(f"{signing_key.key_file()} ({key_id(own.public)}) is not registered")


@keys.command("register")
def register_key(
    label: Annotated[str, typer.Option(help="To tell keys apart (default: this machine's name).")] = "",
) -> None:
    """Let the engine take packages that this machine signs; its key is made if there is none."""
    run(_register_key(label))


async def _register_key(label: str) -> None:
    key, _ = signing_key.load_or_make()
    async with ApiClient.of(credentials.load()) as client:
        await _register(client, key, label)


@keys.command("revoke")
def revoke_key(key: Annotated[str, typer.Argument(help="Its id, as `rce package key` lists it.")]) -> None:
    """Let the engine take no more packages that this key signs; those that are there stay."""
    run(_revoke_key(key))


async def _revoke_key(id_: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        await client.call("DELETE", f"/package-keys/{id_}")
        found = await client.items("/packages", query=of_user(credentials.load().user))
    typer.echo(f"revoked {id_}")
    signed = [f"{one['name']}@{one['version']}" for one in found if one["key"] == id_]
    if signed:
        typer.echo(f"it signed what is still there: {', '.join(signed)}; rce package remove removes it")


async def _register(client: ApiClient, key: SigningKey, label: str = "") -> None:
    body = {"key": key.public, "label": label or socket.gethostname()[:128]}
    reply = await client.call("POST", "/package-keys", body)
    typer.echo(f"registered the key {reply['id']} ({signing_key.key_file()})")


def _name(one: dict[str, Any], found: list[dict[str, Any]]) -> str:
    several = len({other["user"] for other in found}) > 1
    return f"{one['user']}/{one['name']}" if several else str(one["name"])


def _users(one: dict[str, Any]) -> str:
    """Return the nodes that use a version; of many, some of them."""
    more = one["node_count"] - len(one["nodes"])
    return ", ".join(one["nodes"]) + (f", and {more} more" if more else "") or "-"


def _when(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def _bytes(count: float) -> str:
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:  # noqa: PLR2004
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"
