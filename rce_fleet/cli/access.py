"""How ``rce fleet`` reaches a station: its URL, the token, and errors as one line."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import SplitResult, urlsplit

import typer
from pydantic import BaseModel, ValidationError

from rce.masters import split_addresses
from rce.printable import for_terminal, one_line
from rce.tls import CertificateError, client_context
from rce.tls.choice import is_loopback
from rce_fleet.client import ApiError, FleetClient
from rce_fleet.exceptions import StationError
from rce_master.cli import credentials
from rce_master.cli.exceptions import CliError, NotLoggedInError

STATION = "http://127.0.0.1:9080"
LOOPBACK = "127.0.0.1"
"""Stands for all names of this machine."""
TOKEN_VARIABLE = "RCE_STATION_TOKEN"  # noqa: S105 - its name

_UNAUTHORIZED = 401

_TOKEN: ContextVar[str] = ContextVar("token", default="")
_SENDS_LOGIN: ContextVar[bool] = ContextVar("sends_login", default=False)
Token = Annotated[
    str,
    typer.Option(
        "--token",
        envvar=TOKEN_VARIABLE,
        help="Token for the station; prefer the variable, which other users cannot see.",
    ),
]

SendLogin = Annotated[
    bool,
    typer.Option(
        "--send-login",
        help="Send the token of rce login also to a station on another host than the engine's.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print it as JSON.")]
AsJsonLines = Annotated[bool, typer.Option("--json", help="One JSON object a line.")]

Work = Callable[[FleetClient], Coroutine[Any, Any, None]]

Station = Annotated[
    str,
    typer.Option("--station", envvar="RCE_STATION", help="URL of the operator station (rce ui)."),
]


def set_token(token: str, *, sends_login: bool) -> None:
    """Use a token for the command, or that of ``rce login`` for any station."""
    _TOKEN.set(token)
    _SENDS_LOGIN.set(sends_login)


@contextmanager
def checked() -> Iterator[None]:
    """Turn a model's complaint about a value of the command line into one about this value.

    Raises:
        typer.BadParameter: A value is not within its limits.
    """
    try:
        yield
    except ValidationError as error:
        found = error.errors(include_url=False)[0]
        names = [str(step) for step in found["loc"] if not isinstance(step, int)]
        message = str(found["msg"])
        raise typer.BadParameter(
            f"{message[:1].lower()}{message[1:]}, not {found['input']!r}",
            param_hint=f"{' '.join(names)}" if names else None,
        ) from None


def do(station: str, work: Work) -> None:
    """Run a command with a client; print why if it fails.

    The token is ``--token`` or ``RCE_STATION_TOKEN``, or else that of ``rce login`` if the station is on the
    host of the login's engine, or ``--send-login`` is given; none if the station refuses that one.

    Raises:
        typer.BadParameter: A value of the command line is not within its limits.
        typer.Exit: It failed, with code 1, or was interrupted, with code 130.
    """
    try:
        with checked():
            asyncio.run(_do(station, work, _TOKEN.get(), sends_login=_SENDS_LOGIN.get()))
    except (StationError, CliError, CertificateError) as error:
        typer.echo(f"rce fleet: {for_terminal(str(error))}", err=True)
        raise typer.Exit(1) from None
    except BrokenPipeError:
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


async def _do(station: str, work: Work, token: str, *, sends_login: bool) -> None:
    try:
        login = credentials.load()
    except NotLoggedInError:
        await _work(station, work, token, "")  # a station on loopback asks for no login
        return
    why_not = "" if token or sends_login else why_not_sent(login.url, station)
    used = token or ("" if why_not else login.token)
    try:
        await _work(station, work, used, login.authority)
    except ApiError as refused:
        if token or refused.status != _UNAUTHORIZED:
            raise
        if why_not:
            raise CliError(
                f"the station at {station} asks for a login. The login at {login.url} was not sent:"
                f" {why_not}. Give a token ({TOKEN_VARIABLE}), or --send-login if the station belongs to"
                " that engine"
            ) from None
        # The login is at another engine, or has ended; a station on loopback does not need it.
        try:
            await _work(station, work, "", login.authority)
        except ApiError as error:
            if error.status != _UNAUTHORIZED:
                raise
            raise CliError(
                f"the login at {login.url} is not valid at {station}: run rce login with the URL of "
                f"the station's engine, or give a token ({TOKEN_VARIABLE})"
            ) from None


def why_not_sent(login: str, station: str) -> str:
    """Return why a login's token is not for a station: one that gets it may do all that its user may.

    Args:
        login: URLs of the engine's masters, separated by commas.
        station: URL of the station.

    Returns:
        Empty: the station is on the host of one of the masters, and the token is as safe on the way there.
    """
    masters = [urlsplit(url) for url in split_addresses(login)]
    try:
        place = urlsplit(station)
        host = _host(place)
    except ValueError:
        return "the station's URL cannot be read"  # as the client says in detail
    here = [master for master in masters if _host(master) == host]
    if not here:
        return f"{place.hostname or station} is not a host of that engine"
    if place.scheme != "https" and host != LOOPBACK and all(master.scheme == "https" for master in here):
        return "the way to the station is not encrypted, as the one to the engine is"
    return ""


def _host(url: SplitResult) -> str:
    host = (url.hostname or "").rstrip(".")
    return LOOPBACK if is_loopback(host) else host


async def _work(station: str, work: Work, token: str, authority: str) -> None:
    tls = client_context(Path(authority) if authority else None)
    try:
        reached = FleetClient(station, token, tls=tls, attempts=3)
    except ValueError as error:
        raise CliError(str(error)) from error
    async with reached as client:
        await work(client)


def echo_table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    """Print columns of the width that they need, without what a terminal would interpret."""
    lines = [header, *(tuple(map(one_line, row)) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    for line in lines:
        cells = (text.ljust(width) for text, width in zip(line, widths, strict=True))
        typer.echo("  ".join(cells).rstrip())


def echo_json(found: BaseModel | Sequence[BaseModel]) -> None:
    """Print a model, or a list of models, as the API returns them."""
    if isinstance(found, BaseModel):
        typer.echo(json.dumps(found.model_dump(mode="json"), indent=2))
    else:
        typer.echo(json.dumps([each.model_dump(mode="json") for each in found], indent=2))


def echo_json_line(found: BaseModel) -> None:
    """Print a model as a line of JSON."""
    typer.echo(json.dumps(found.model_dump(mode="json")))
