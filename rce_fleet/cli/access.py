"""How ``rce fleet`` reaches a station: its URL, the token, and errors as one line."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from rce.tls import CertificateError, client_context
from rce_fleet.client import ApiError, FleetClient
from rce_fleet.exceptions import StationError
from rce_master.cli import credentials
from rce_master.cli.exceptions import CliError, NotLoggedInError

STATION = "http://127.0.0.1:9080"
TOKEN_VARIABLE = "RCE_STATION_TOKEN"  # noqa: S105 - its name

_UNAUTHORIZED = 401

_TOKEN: ContextVar[str] = ContextVar("token", default="")
Token = Annotated[
    str,
    typer.Option(
        "--token",
        envvar=TOKEN_VARIABLE,
        help="Token for the station; prefer the variable, which other users cannot see.",
    ),
]

Work = Callable[[FleetClient], Coroutine[Any, Any, None]]

Station = Annotated[
    str,
    typer.Option("--station", envvar="RCE_STATION", help="URL of the operator station (rce ui)."),
]


def set_token(token: str) -> None:
    """Use a token for the command."""
    _TOKEN.set(token)


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

    The token is ``--token`` or ``RCE_STATION_TOKEN``, or else that of ``rce login``; none if the station
    refuses that one.

    Raises:
        typer.BadParameter: A value of the command line is not within its limits.
        typer.Exit: It failed, with code 1, or was interrupted, with code 130.
    """
    try:
        with checked():
            asyncio.run(_do(station, work, _TOKEN.get()))
    except (StationError, CliError, CertificateError) as error:
        typer.echo(f"rce fleet: {error}", err=True)
        raise typer.Exit(1) from None
    except BrokenPipeError:
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


async def _do(station: str, work: Work, token: str) -> None:
    try:
        login = credentials.load()
    except NotLoggedInError:
        await _work(station, work, token, "")  # a station on loopback asks for no login
        return
    try:
        await _work(station, work, token or login.token, login.authority)
    except ApiError as refused:
        if token or refused.status != _UNAUTHORIZED:
            raise
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


async def _work(station: str, work: Work, token: str, authority: str) -> None:
    tls = client_context(Path(authority) if authority else None)
    try:
        reached = FleetClient(station, token, tls=tls, attempts=3)
    except ValueError as error:
        raise CliError(str(error)) from error
    async with reached as client:
        await work(client)


def echo_table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    """Print columns of the width that they need."""
    lines: list[tuple[str, ...]] = [header, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    for line in lines:
        cells = (text.ljust(width) for text, width in zip(line, widths, strict=True))
        typer.echo("  ".join(cells).rstrip())
