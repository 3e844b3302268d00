"""``rce logs`` and ``rce events``: read and follow."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, run
from rce_master.cli.exceptions import ApiError

if TYPE_CHECKING:
    from rce_master.events import Event

POLL_S = 0.3
CHUNK = 65536
_UNAVAILABLE = 503


def logs(
    node: Annotated[
        str, typer.Argument(metavar="CONTAINER[/NODE]", help="Without a node: the environment's own log.")
    ],
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what comes.")] = False,
    bytes_: Annotated[int, typer.Option("--bytes", help="Begin that many bytes before the end; 0: all.")] = 0,
    user: Annotated[str, typer.Option(help="Whose container; administrators only.")] = "",
) -> None:
    """Print the log of a node."""
    run(_logs(node, follow, -bytes_, user))


async def _logs(path: str, follow: bool, offset: int, user: str) -> None:
    container, _, node = path.partition("/")
    url = f"/containers/{container}/nodes/{node}/log" if node else f"/containers/{container}/log"
    query: dict[str, str | int] = {"limit": CHUNK, **({"user": user} if user else {})}
    async with ApiClient.of(credentials.load()) as client:
        while True:
            chunk = await _read(client, url, {**query, "offset": offset}, patient=follow)
            if chunk is not None:
                typer.echo(chunk["text"], nl=False)
                offset = chunk["offset"]
                if chunk["text"]:
                    continue
            if not follow:
                return
            await asyncio.sleep(POLL_S)


async def _read(
    client: ApiClient, url: str, query: dict[str, str | int], *, patient: bool
) -> dict[str, Any] | None:
    """Read a piece; None if the container is out of reach for now and we can wait."""
    try:
        chunk: dict[str, Any] = await client.call("GET", url, query=query)
    except ApiError as error:
        if patient and error.status == _UNAVAILABLE:
            return None
        raise
    return chunk


def events(
    since: Annotated[int | None, typer.Option(help="Begin after the event of this id.")] = None,
    json_: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
) -> None:
    """Print what happens, until Ctrl-C."""
    run(_events(since, json_))


async def _events(since: int | None, as_json: bool) -> None:
    import msgspec

    async with ApiClient.of(credentials.load()) as client:
        async for event in client.events(since):
            typer.echo(msgspec.json.encode(event).decode() if as_json else _line(event))


def _line(event: Event) -> str:
    when = time.strftime("%H:%M:%S", time.localtime(event.time))
    return f"{when} {event.kind:<24} {event.subject} {event.text}".rstrip()
