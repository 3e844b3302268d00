"""``rce login`` and ``rce logout``."""

from __future__ import annotations

import contextlib
import sys
from typing import Annotated

import typer

from rce.cli.options import Authority
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, run
from rce_master.cli.exceptions import ApiError, CliError

DEFAULT_URL = "http://127.0.0.1:9000/"


def login(
    url: Annotated[str, typer.Argument(help="The master's address; several by commas.")] = DEFAULT_URL,
    *,
    user: Annotated[str, typer.Option("--user", "-u", prompt=True, help="User name.")],
    password_stdin: Annotated[bool, typer.Option(help="Read the password from standard input.")] = False,
    authority: Authority = None,
) -> None:
    """Log in at a master and keep the token for the other commands."""
    file = "" if authority is None else str(authority.absolute())
    run(_login(url, user, read_password(from_stdin=password_stdin), file))


async def _login(url: str, user: str, password: str, authority: str) -> None:
    async with ApiClient(url, authority=authority) as client:
        reply = await client.call(
            "POST", "/login", {"userID": user, "password": password, "label": "rce login"}
        )
        await _give_back(url)
    file = credentials.save(
        credentials.Credentials(
            url=url, user=user, token=reply["token"], expires=reply["expires"], authority=authority
        )
    )
    typer.echo(f"logged in as {user} ({reply['role']}); the token is in {file}")


async def _give_back(url: str) -> None:
    """Revoke the token of the former login, if it is at the same master."""
    with contextlib.suppress(CliError, ApiError):  # missing, unreadable or expired: nothing to revoke
        former = credentials.load()
        if former.url == url:
            async with ApiClient.of(former) as client:
                await client.call("DELETE", "/login")


def logout() -> None:
    """Log out: revoke the token and delete it."""
    run(_logout())


async def _logout() -> None:
    async with ApiClient.of(credentials.load()) as client:
        await client.call("DELETE", "/login")
    credentials.forget()
    typer.echo("logged out")


def read_password(*, from_stdin: bool, confirm: bool = False, what: str = "Password") -> str:
    """Read a password: ask for it at a terminal, else read the next line of standard input."""
    if from_stdin:
        return sys.stdin.readline().rstrip("\n")
    return str(typer.prompt(what, hide_input=True, confirmation_prompt=confirm))
