"""``rce token`` and ``rce robot``: the tokens of logins, programs and robots."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer
from rich.console import Console

from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, OfUserByAdmin, of_user, run
from rce_master.cli.exceptions import NotLoggedInError
from rce_master.cli.tables import TextTable

tokens = typer.Typer(invoke_without_command=True, help="Print, list, make and revoke tokens.")
robots = typer.Typer(no_args_is_help=True, help="Add, list and revoke tokens of robots.")

Label = Annotated[str, typer.Option(help="Your name for the token.")]
Days = Annotated[float, typer.Option(help="Days until it expires; 0: valid until it is revoked.", min=0)]


@tokens.callback()
def token(context: typer.Context) -> None:
    """Print the token, for use by other programs: curl -H "Authorization: Bearer $(rce token)" ..."""
    if context.invoked_subcommand is None:
        run(_print())


async def _print() -> None:
    found = credentials.load()
    if found.expires <= time.time():
        raise NotLoggedInError
    typer.echo(found.token)


@tokens.command("list")
def list_tokens(user: OfUserByAdmin = "") -> None:
    """List your tokens, with expiry and last use."""
    run(_list("/tokens", user))


@tokens.command("new")
def new_token(
    metrics: Annotated[bool, typer.Option("--metrics", help="Valid for reading /metrics only.")] = False,
    fleet: Annotated[
        bool, typer.Option("--fleet", help="Valid at operator stations only, with the user's role.")
    ] = False,
    label: Label = "",
    days: Days = 0.0,
    user: OfUserByAdmin = "",
) -> None:
    """Make and print a token for a program."""
    if metrics == fleet:
        raise typer.BadParameter("say what it is for: --metrics or --fleet (for yourself, log in: rce login)")
    scope = "metrics" if metrics else "fleet"
    run(_new("/tokens", {"scope": scope, "label": label, "days": days}, user))


@tokens.command("revoke")
def revoke_tokens(
    ids: Annotated[list[str], typer.Argument(metavar="ID...", help="As rce token list shows them.")],
    user: OfUserByAdmin = "",
) -> None:
    """Revoke tokens; what was opened by them ends."""
    run(_revoke("/tokens", ids, user))


@robots.command("add")
def add_robot(
    robot: Annotated[str, typer.Argument(help="The robot ID.")],
    replace: Annotated[bool, typer.Option("--replace", help="Replace the token that it has.")] = False,
    label: Label = "",
    days: Days = 0.0,
    user: OfUserByAdmin = "",
) -> None:
    """Make and print a token that is valid for this robot ID only: "token" in the robot's file."""
    body = {"robot": robot, "label": label, "days": days, "replace": replace}
    run(_new("/robot-tokens", body, user))


@robots.command("list")
def list_robots(user: OfUserByAdmin = "") -> None:
    """List the robots that have a token."""
    run(_list("/robot-tokens", user))


@robots.command("revoke")
def revoke_robots(
    names: Annotated[list[str], typer.Argument(metavar="ROBOT...", help="Robot IDs.")],
    user: OfUserByAdmin = "",
) -> None:
    """Revoke robots' tokens; their sessions end."""
    run(_revoke("/robot-tokens", names, user))


async def _list(path: str, user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        found = await client.items(path, "tokens", of_user(user))
    table = TextTable("id", "for", "label", "since", "expires", "last used")
    for each in sorted(found, key=lambda one: float(one["created"])):
        table.add(
            each["id"],
            each["scope"] or ("this login" if each["current"] else "login"),
            each["label"],
            _day(each["created"]),
            _day(each["expires"]),
            _moment(each["used"]),
        )
    Console().print(table)


async def _new(path: str, body: dict[str, Any], user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        reply = await client.call("POST", path, body, query=of_user(user))
    typer.echo(reply["token"])
    until = f"until {_day(reply['expires'])}" if reply["expires"] else "until it is revoked"
    typer.echo(f"rce: good for {reply['scope']} of user {reply['userID']}, {until}; shown only now", err=True)


async def _revoke(path: str, names: list[str], user: str) -> None:
    async with ApiClient.of(credentials.load()) as client:
        for name in names:
            await client.call("DELETE", f"{path}/{name}", query=of_user(user))
            typer.echo(f"revoked {name}")


def _day(when: float) -> str:
    return time.strftime("%Y-%m-%d", time.localtime(when)) if when else "never"


def _moment(when: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(when)) if when else "never"
