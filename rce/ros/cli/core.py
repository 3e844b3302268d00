"""``rce core``: a ROS master and parameter server, without a ROS installation."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Annotated

import typer
import uvloop

from rce.cli.program_files import from_file
from rce.ros.core import Core
from rce.ros.core.server import DEFAULT_PORT
from rce.ros.logfiles import log_folder

GOODBYE_S = 0.1
"""Seconds between a request to end and the end, so that its sender gets an answer."""


@from_file("core")
def core(
    port: Annotated[
        int, typer.Option("--port", "-p", min=0, max=65535, help="Port to listen on; 0: any free port.")
    ] = DEFAULT_PORT,
    bind: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for all.")] = "127.0.0.1",
    advertised: Annotated[
        str, typer.Option(help="Host name in the core's URI; default: the bound address.")
    ] = "",
    log_dir: Annotated[
        Path | None,
        typer.Option(
            file_okay=False,
            help="Folder of RUN_ID/rosout.log; default: ROS_LOG_DIR, or log in ROS_HOME or ~/.ros.",
        ),
    ] = None,
    log: Annotated[bool, typer.Option(help="Write rosout.log.")] = True,
) -> None:
    """Run a ROS core, in place of roscore."""
    try:
        folder = (log_dir or log_folder(os.environ)) if log else None
        uvloop.run(_serve(bind, port, advertised or None, folder))
    except OSError as error:
        raise typer.BadParameter(f"cannot listen on {bind}:{port}: {error.strerror or error}") from error


async def _serve(bind: str, port: int, advertised: str | None, folder: Path | None) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)

    def told(reason: str) -> None:
        typer.echo(f"rce core stops: {reason}")
        loop.call_later(GOODBYE_S, stop.set)

    async with Core(
        bind, port, advertised=advertised, rosout=True, log_folder=folder, on_shutdown=told
    ) as running:
        typer.echo(f"rce core ready: ROS_MASTER_URI={running.uri}")
        await stop.wait()
