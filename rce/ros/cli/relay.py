"""``rce relay FROM TO``: publish a topic under another name, like topic_tools' relay and throttle."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from typing import Annotated

import typer
import uvloop

from rce.aio.tasks import errors_in
from rce.cli.program_files import from_file
from rce.config import start_logging
from rce.ros.errors import RosError
from rce.ros.multimaster.relay.throttle import ByteThrottle, MessageThrottle, Throttle
from rce.ros.multimaster.relay.topic import TopicRelay
from rce.ros.multimaster.settings import local_master
from rce.ros.node import Node


@from_file("relay")
def relay(
    source: Annotated[str, typer.Argument(metavar="FROM", help="Topic to subscribe to, of any type.")],
    target: Annotated[str, typer.Argument(metavar="TO", help="Topic to publish.")],
    throttle: Annotated[
        float | None, typer.Option(metavar="HZ", help="Maximum number of messages per second.")
    ] = None,
    max_bytes: Annotated[float | None, typer.Option(help="Maximum number of bytes per second.")] = None,
    window: Annotated[float, typer.Option(help="Seconds over which --max-bytes is averaged.")] = 1.0,
    lazy: Annotated[bool, typer.Option(help="Subscribe only while the output has subscribers.")] = False,
    latch: Annotated[
        bool, typer.Option(help="Latch the output: keep the last message for later subscribers.")
    ] = False,
    name: Annotated[str, typer.Option(help="Name of the node; default: a unique one.")] = "",
    master_uri: Annotated[str, typer.Option(help="URI of the master; default: ROS_MASTER_URI.")] = "",
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show log messages.")] = False,
) -> None:
    """Publish a topic under another name."""
    level = logging.INFO if verbose else logging.WARNING
    start_logging(level, line="%(levelname)s %(message)s")
    try:
        chosen = _throttle(throttle, max_bytes, window)
        node = Node(
            name or "relay",
            argv=[],
            master_uri=local_master(master_uri),
            anonymous=not name,
            signals=False,
            master_timeout=None,
        )
        _check(node, source, target)
        uvloop.run(_run(node, TopicRelay(source, target, throttle=chosen, lazy=lazy, latch=latch)))
    except* (RosError, ValueError) as errors:
        typer.echo(f"rce relay: {next(errors_in(errors))}", err=True)
        raise typer.Exit(1) from None


def _check(node: Node, source: str, target: str) -> None:
    if node.resolve(source) == node.resolve(target):
        raise ValueError(f"{source} cannot be relayed to itself; give another topic")


def _throttle(hertz: float | None, max_bytes: float | None, window: float) -> Throttle | None:
    if hertz is not None and max_bytes is not None:
        raise ValueError("give --throttle or --max-bytes, not both")
    if hertz is not None:
        return MessageThrottle(hertz)
    return ByteThrottle(max_bytes, window) if max_bytes is not None else None


async def _run(node: Node, topic_relay: TopicRelay) -> None:
    main = asyncio.current_task()
    assert main is not None
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, main.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        async with node, asyncio.TaskGroup() as group:
            work = group.create_task(topic_relay.run(node))
            await node.spin()  # until the master or rosnode kill stops it
            work.cancel()
