"""``rce logs`` and ``rce events``: read and follow."""

from __future__ import annotations

import asyncio
import sys
import time
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rce.control import LogLevel
from rce.printable import for_terminal, one_line
from rce_master.cli import credentials
from rce_master.cli.attempts import NOT_NOW
from rce_master.cli.client import ApiClient, run
from rce_master.cli.exceptions import ApiError, CliError

if TYPE_CHECKING:
    from rce_master.events import Event

POLL_S = 0.3
CHUNK = 65536
_NOT_FOUND = 404


def logs(
    node: Annotated[
        str, typer.Argument(metavar="CONTAINER[/NODE]", help="Without a node: the environment's own log.")
    ],
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Follow the log.")] = False,
    bytes_: Annotated[int, typer.Option("--bytes", help="Begin that many bytes before the end; 0: all.")] = 0,
    stdout: Annotated[bool, typer.Option("--stdout", help="The node's standard output.")] = False,
    stderr: Annotated[bool, typer.Option("--stderr", help="The node's standard error.")] = False,
    rosout: Annotated[
        bool, typer.Option("--rosout", help="The node's ROS log; without a node: that of all nodes.")
    ] = False,
    engine: Annotated[bool, typer.Option("--engine", help="The engine's messages about the node.")] = False,
    level: Annotated[
        LogLevel | None, typer.Option(help="ROS log records of this level and above; implies --rosout.")
    ] = None,
    previous: Annotated[
        bool, typer.Option("--previous", "-p", help="The log of the last incarnation that ended.")
    ] = False,
    user: Annotated[str, typer.Option(help="Whose container; not for role user.")] = "",
) -> None:
    """Print the log of a node. Several of --stdout, --stderr, --rosout and --engine may be given; else all.

    The logs of a container that is gone are kept for a while, and are read in the same way.
    """
    chosen = {"stdout": stdout, "stderr": stderr, "rosout": rosout or level is not None, "engine": engine}
    query = {
        "stream": ",".join(name for name, wanted in chosen.items() if wanted),
        "level": level.value if level else "",
        "previous": "true" if previous else "",
        "user": user,
    }
    run(_logs(node, follow, -bytes_, {name: value for name, value in query.items() if value}))


async def _logs(path: str, follow: bool, offset: int, query: dict[str, str]) -> None:
    container, _, node = path.partition("/")
    url = f"/containers/{container}/nodes/{node}/log" if node else f"/containers/{container}/log"
    incarnation, told, reached = "", "", False
    async with ApiClient.of(credentials.load()) as client:
        while True:
            place = {"limit": CHUNK, "offset": offset}
            of_incarnation = {"life": incarnation} if incarnation else {}
            asked: dict[str, str | int] = {**query, **place, **of_incarnation}
            chunk = await _read(client, url, asked, patient=follow, reached=reached)
            if chunk is not None:
                reached = True
                if chunk["ended"] and told != chunk["life"]:
                    told = chunk["life"]
                    typer.echo(_obituary(chunk), err=True)
                typer.echo(_shown(chunk["text"]), nl=False)
                incarnation, before, offset = chunk["life"], offset, chunk["offset"]
                if offset != before:
                    continue
            if not follow:
                return
            await asyncio.sleep(POLL_S)
            if chunk is not None and chunk["ended"] and await _started_again(client, url, query, incarnation):
                incarnation, offset = "", 0
                query.pop("previous", None)


async def _started_again(client: ApiClient, url: str, query: dict[str, str], incarnation: str) -> bool:
    """Whether the container has a newer incarnation than the one that was read to its end."""
    now = {name: value for name, value in query.items() if name == "user"}
    try:
        chunk = await _read(client, url, {**now, "limit": 1}, patient=True, reached=True)
    except ApiError as error:
        if error.status == _NOT_FOUND:
            return False
        raise
    return chunk is not None and chunk["life"] != incarnation


def _shown(text: str) -> str:
    """Return a log's text; for a terminal, without control characters."""
    return for_terminal(text) if sys.stdout.isatty() else text


def _obituary(chunk: dict[str, Any]) -> str:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(chunk["ended"]))
    reason = one_line(chunk["reason"]) or "unknown reason"
    return f"-- the container's incarnation {chunk['life']} ended {when}: {reason} --"


async def _read(
    client: ApiClient, url: str, query: dict[str, str | int], *, patient: bool, reached: bool
) -> dict[str, Any] | None:
    """Read a piece; return None if there is none for now and the program can wait.

    Args:
        client: Of the master.
        url: The log.
        query: Which piece.
        patient: Wait for a container that is unreachable.
        reached: The master answered before, so a patient program waits for it too: it may restart.

    Raises:
        CliError: The log cannot be read.
    """
    try:
        chunk: dict[str, Any] = await client.call("GET", url, query=query)
    except CliError as error:
        status = error.status if isinstance(error, ApiError) else HTTPStatus.BAD_GATEWAY
        if patient and status in (NOT_NOW if reached else (HTTPStatus.SERVICE_UNAVAILABLE,)):
            return None
        raise
    return chunk


def events(
    since: Annotated[int | None, typer.Option(help="Begin after the event of this id.")] = None,
    json_: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
) -> None:
    """Print events until Ctrl-C."""
    run(_events(since, json_))


async def _events(since: int | None, as_json: bool) -> None:
    import msgspec

    async with ApiClient.of(credentials.load()) as client:
        async for event in client.events(since):
            typer.echo(msgspec.json.encode(event).decode() if as_json else _line(event))


def _line(event: Event) -> str:
    when = time.strftime("%H:%M:%S", time.localtime(event.time))
    return one_line(f"{when} {event.kind:<24} {event.subject} {event.text}".rstrip())
