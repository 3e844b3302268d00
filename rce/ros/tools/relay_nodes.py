"""The nodes ``relay`` and ``throttle`` of ROS's package ``topic_tools``, with their arguments.

``relay IN [OUT]`` publishes a topic under another name; ``throttle messages IN HZ [OUT]`` and
``throttle bytes IN BYTES_PER_SECOND WINDOW [OUT]`` leave messages out. With the parameter ``~lazy`` they take
messages only while the output has subscribers; with ``~wall_clock``, a throttle does not count in ROS time.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence

from rce.ros.errors import RosError
from rce.ros.multimaster.relay.throttle import ByteThrottle, MessageThrottle, Throttle
from rce.ros.multimaster.relay.topic import TopicRelay
from rce.ros.names import parse_arguments, segments
from rce.ros.node import Node, run

RELAY_USAGE = "relay IN [OUT]"
THROTTLE_USAGE = "throttle messages IN HZ [OUT], or throttle bytes IN BYTES_PER_SECOND WINDOW [OUT]"


def relay() -> int:
    """Run the node ``relay``; return the program's exit code."""
    words = parse_arguments(sys.argv[1:]).rest
    match words:
        case [source] | [source, _]:
            target = words[1] if len(words) > 1 else f"{source}_relay"
            return run(_serve("relay", source, target, None))
        case _:
            return _refuse(RELAY_USAGE, words)


def throttle() -> int:
    """Run the node ``throttle``; return the program's exit code."""
    words = parse_arguments(sys.argv[1:]).rest
    try:
        match words:
            case ["messages", source, rate, *rest] if len(rest) < 2:  # noqa: PLR2004 - one name at most
                chosen: Throttle = MessageThrottle(float(rate))
            case ["bytes", source, rate, window, *rest] if len(rest) < 2:  # noqa: PLR2004
                chosen = ByteThrottle(float(rate), float(window))
            case _:
                return _refuse(THROTTLE_USAGE, words)
    except ValueError as error:
        return _refuse(f"{THROTTLE_USAGE}: {error}", words)
    return run(_serve("throttle", source, rest[0] if rest else f"{source}_throttle", chosen))


def _refuse(usage: str, words: Sequence[str]) -> int:
    print(f"usage: {usage}; found {' '.join(words) or 'no arguments'}", file=sys.stderr)  # noqa: T201
    return 2


async def _serve(name: str, source: str, target: str, chosen: Throttle | None) -> int:
    base = segments(source)[-1] if segments(source) else "topic"
    try:
        async with Node(f"{base}_{name}", anonymous=True) as node:
            lazy = bool(await node.get_param("~lazy", default=False))
            wall_clock = bool(await node.get_param("~wall_clock", default=False))
            relay = TopicRelay(source, target, throttle=chosen, lazy=lazy, wall_clock=wall_clock)
            work = asyncio.ensure_future(relay.run(node))
            stopped = asyncio.ensure_future(node.spin())
            await asyncio.wait((work, stopped), return_when=asyncio.FIRST_COMPLETED)
            stopped.cancel()
            if not work.done():
                work.cancel()
                return 0
            work.result()
    except (RosError, ValueError) as error:
        print(f"{name}: {error}", file=sys.stderr)  # noqa: T201
        return 1
    return 0
