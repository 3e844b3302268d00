"""The move client under the paper's name, with its topics as arguments, in any order.

``move_client_pthread /Robot1/goalNodesList /Robot1/cancelGoal /Robot1/amcl_pose /Robot1/move_base``

Each topic is recognized by its last word. The namespace of ``goalNodesList`` is the robot's; the others may
be anywhere. Everything else is as in :mod:`rce_fleet.nodes.move_client`, with the same parameters.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rce.ros.names import canonical, is_global, is_graph_name, namespace_of, parse_arguments, segments
from rce.ros.node import Node, run
from rce.ros.node.hosting import program_arguments
from rce_fleet.nodes.move_client import MoveClientNode

USAGE = (
    "move_client_pthread takes topics, such as /Robot1/goalNodesList /Robot1/cancelGoal /Robot1/amcl_pose"
    " /Robot1/move_base"
)
LIST = "goalNodesList"
CANCEL = "cancelGoal"
ACTION = "move_base"
MOVE_BASE = ("goal", "cancel", "status", "result", "feedback")
UNUSED = "amcl_pose"
"""Accepted, as the paper's move client takes it; ours knows from ``move_base`` where its robot is."""
_BAD_USAGE = 2


def name_arguments(words: Sequence[str]) -> list[str]:
    """Return the command line of a move client with these topics.

    Args:
        words: The program's arguments: topics, and what any ROS node takes.

    Raises:
        ValueError: A word is not a topic of a move client, two have the same last word, or there is no
            ``goalNodesList``.
    """
    given = parse_arguments(words)
    topics: dict[str, str] = {}
    for word in given.rest:
        parts = segments(word)
        kind = parts[-1] if parts else ""
        if not is_graph_name(word) or not is_global(word) or kind not in (LIST, CANCEL, ACTION, UNUSED):
            raise ValueError(f"{USAGE}; found {word!r}")
        if topics.setdefault(kind, canonical(word)) != canonical(word):
            raise ValueError(f"{USAGE}; found {topics[kind]} and {word}")
    if LIST not in topics:
        raise ValueError(f"{USAGE}; found no goalNodesList")
    namespace = namespace_of(topics[LIST]).rstrip("/")
    if len(segments(namespace)) != 1:
        raise ValueError(f"{USAGE}; {topics[LIST]} is not in a robot's namespace, such as /Robot1")
    made = [word for word in words if word not in given.rest]
    if "__ns" not in given.specials:
        made.append(f"__ns:={namespace}")
    for kind, topic in topics.items():
        names = [f"/{name}" for name in MOVE_BASE] if kind == ACTION else [""]
        made += [f"{kind}{name}:={topic}{name}" for name in names]
    return made


async def main() -> int:
    """Run the node until it is stopped; return the program's exit code."""
    try:
        argv = name_arguments(program_arguments())
    except ValueError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return _BAD_USAGE
    async with Node("move_client", argv=argv, signals=True) as node:
        await MoveClientNode(node).run()
    return 0


if __name__ == "__main__":
    sys.exit(run(main()))
