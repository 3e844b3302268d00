"""``rce user``: users, by the API of a running master or right in its state folder."""

from __future__ import annotations

import time
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer
from rich.console import Console

from rce.config import EtcdAddress
from rce_master.auth import Authenticator, client_digest
from rce_master.cli import credentials, limits
from rce_master.cli.client import ApiClient, run
from rce_master.cli.exceptions import CliError
from rce_master.cli.offline import OfflineState, StateDir, StoreOption, choose, open_state, read_etcd
from rce_master.cli.session import read_password
from rce_master.cli.tables import TextTable
from rce_master.state import commands
from rce_master.state.user_records import User, UserRole

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

app = typer.Typer(no_args_is_help=True, help="Add, list and remove users, change passwords and limits.")
app.command("show")(limits.show)
app.command("limit")(limits.limit)

UserName = Annotated[str, typer.Argument(help="Name of the user.")]
PasswordStdin = Annotated[bool, typer.Option(help="Read the password from standard input.")]


@app.command("add")
def add(
    name: UserName,
    role: Annotated[UserRole, typer.Option(help="What the user may do.")] = UserRole.USER,
    admin: Annotated[bool, typer.Option("--admin", help="The same as --role admin.")] = False,
    password_stdin: PasswordStdin = False,
    state_dir: StateDir = None,
    store: StoreOption = "",
) -> None:
    """Add a user."""
    run(
        _add(
            name,
            "admin" if admin else role.value,
            read_password(from_stdin=password_stdin, confirm=True),
            state_dir,
            store,
        )
    )


async def _add(name: str, role: str, password: str, state_dir: Path | None, store: str) -> None:
    async with _directory(state_dir, store) as users:
        await users.add(name, role, password)
    typer.echo(f"added {name} {users.place}")


@app.command("list")
def list_(state_dir: StateDir = None) -> None:
    """List all users."""
    run(_list(state_dir))


async def _list(state_dir: Path | None) -> None:
    async with _directory(state_dir) as users:
        found = await users.list()
    table = TextTable("user", "role", "since")
    for user in found:
        table.add(user["name"], user["role"], time.strftime("%Y-%m-%d", time.localtime(user["created"])))
    Console().print(table)


@app.command("passwd")
def passwd(name: UserName, password_stdin: PasswordStdin = False, state_dir: StateDir = None) -> None:
    """Change a user's password; of your own, the old one is asked for first (or is the first line)."""
    old = read_password(from_stdin=password_stdin, what="Old password") if _is_own(name, state_dir) else ""
    run(_passwd(name, old, read_password(from_stdin=password_stdin, confirm=True), state_dir))


def _is_own(name: str, state_dir: Path | None) -> bool:
    """Whether it is the logged-in user's own password, changed over the API."""
    try:
        return state_dir is None and credentials.load().user == name
    except CliError:
        return False


async def _passwd(name: str, old: str, password: str, state_dir: Path | None) -> None:
    async with _directory(state_dir) as users:
        await users.set_password(name, password, old)
    typer.echo(f"changed the password of {name} {users.place}")


@app.command("remove")
def remove(name: UserName, state_dir: StateDir = None) -> None:
    """Remove a user with all robots and containers."""
    run(_remove(name, state_dir))


async def _remove(name: str, state_dir: Path | None) -> None:
    async with _directory(state_dir) as users:
        await users.remove(name)
    typer.echo(f"removed {name} {users.place}")


@app.command("role")
def set_role(
    name: UserName,
    role: Annotated[UserRole, typer.Argument(help="What the user may do.")],
    state_dir: StateDir = None,
) -> None:
    """Change what a user may do."""
    run(_set_role(name, role.value, state_dir))


async def _set_role(name: str, role: str, state_dir: Path | None) -> None:
    async with _directory(state_dir) as users:
        await users.set_role(name, role)
    typer.echo(f"{name} has the role {role} now")


class _Directory(Protocol):
    @property
    def place(self) -> str:
        """The place of the users, for messages."""

    async def add(self, name: str, role: str, password: str) -> None: ...
    async def list(self) -> list[dict[str, Any]]: ...
    async def set_password(self, name: str, password: str, old: str) -> None: ...
    async def set_role(self, name: str, role: str) -> None: ...
    async def remove(self, name: str) -> None: ...


class _ApiDirectory:
    """Users over the API of a running master."""

    def __init__(self, client: ApiClient, url: str) -> None:
        self._client = client
        self.place = f"at {url}"

    async def add(self, name: str, role: str, password: str) -> None:
        await self._client.call("POST", "/users", {"name": name, "role": role, "password": password})

    async def list(self) -> list[dict[str, Any]]:
        return await self._client.items("/users")

    async def set_password(self, name: str, password: str, old: str) -> None:
        body = {"password": password, "old_password": old}
        await self._client.call("PUT", f"/users/{name}/password", body)

    async def set_role(self, name: str, role: str) -> None:
        await self._client.call("PUT", f"/users/{name}/role", {"role": role})

    async def remove(self, name: str) -> None:
        await self._client.call("DELETE", f"/users/{name}")


class _StoreDirectory:
    """Users directly in the store, which is locked meanwhile."""

    def __init__(self, offline: OfflineState) -> None:
        self.place = f"in {offline.place}"
        self._offline = offline
        self._authenticator = Authenticator(offline.state.tables)

    async def add(self, name: str, role: str, password: str) -> None:
        hashed = await self._authenticator.hash(client_digest(password))
        user = User(name=name, role=UserRole(role), password=hashed, created=time.time())
        await self._offline.do(commands.AddUser(user=user), "add_user", f"{name}/{role}")

    async def list(self) -> list[dict[str, Any]]:
        return [
            {"name": user.name, "role": user.role.value, "created": user.created}
            for user in self._offline.state.tables.users
        ]

    async def set_password(self, name: str, password: str, old: str) -> None:
        del old  # a user who may write the folder may do everything
        hashed = await self._authenticator.hash(client_digest(password))
        await self._offline.do(commands.SetPassword(name=name, password=hashed), "set_password", name)

    async def set_role(self, name: str, role: str) -> None:
        command = commands.SetRole(name=name, role=UserRole(role))
        await self._offline.do(command, "set_role", f"{name}/{role}")

    async def remove(self, name: str) -> None:
        users = self._offline.state.tables.users
        command = commands.RemoveUser(name=name)
        await self._offline.do(command, "remove_user", name, is_done=lambda: name not in users)

    def close(self) -> None:
        self._authenticator.close()


@asynccontextmanager
async def _directory(state_dir: Path | None, store: str = "") -> AsyncIterator[_Directory]:
    """Choose the named etcd or folder, else the master of the login, else the default folder."""
    place = read_etcd(store) if store else choose(state_dir)
    if not isinstance(place, Path | EtcdAddress):
        async with ApiClient.of(place) as client:
            yield _ApiDirectory(client, place.url)
        return
    async with open_state(place, state_dir if store else None) as offline:
        directory = _StoreDirectory(offline)
        try:
            yield directory
        finally:
            directory.close()
