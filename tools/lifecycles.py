"""Makes the page of life cycles, with a diagram of each, from their tables in the code."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import griffe

import rce.ros.actions.states
import rce_client.life
import rce_container.environment.nodes.life
import rce_container.life
import rce_fleet.coordination.move_client
import rce_fleet.coordination.robot
import rce_fleet.navigation.move_base.core
import rce_fleet.tasks.task
import rce_master.leadership.core
import rce_master.state.lifecycle
from rce.lifecycle import LifeCycle
from tools.state_diagram import draw, word

IMAGES = "docs/images/lifecycles"
_ROLE = re.compile(r":\w+:`~?(?:[\w.]+\.)?(\w+)`")

HEAD = """\
# Life cycles

For developers, and for operators who want to know how a state comes about. This page and its pictures are
made from the tables in the code (`make reference`).

In the pictures, what leads to a state below leaves on the right side, what leads to one above on the left.
Lines that meet at a dot lead to the same state. Any state of a box may follow any other one in it. A grey
box is an end. An event that changes nothing is only in the table; one that is not in a state's row cannot
happen there."""


class Cycle(NamedTuple):
    """A life cycle with its place on the page."""

    title: str
    name: str
    """Of its picture."""
    text: str
    life: LifeCycle[Any, Any]


CYCLES = (
    Cycle(
        "Container, as the master sees it",
        "container-master",
        "What `rce ps` shows. From *placed* on it is what the container's task set reports.",
        rce_master.state.lifecycle.CONTAINER_LIFE,
    ),
    Cycle(
        "Move of a container with volumes",
        "volume-move",
        "Its container is ended first; see [volumes](containers.md#volumes-that-move).",
        rce_master.state.lifecycle.VOLUME_MOVE_LIFE,
    ),
    Cycle(
        "Container, as its machine sees it",
        "container",
        "What `rce-container` does to make and remove a container; *cleaning* is *failed* for the master.",
        rce_container.life.CONTAINER_LIFE,
    ),
    Cycle(
        "Node",
        "node",
        "A node of a container, as its environment sees it.",
        rce_container.environment.nodes.life.NODE_LIFE,
    ),
    Cycle(
        "Master among several",
        "leadership",
        "With a store in etcd ([three masters](../how-to/three-masters.md)). `GET /healthz` shows the role"
        " `leader` while a master is leading, and `standby` in the other states.",
        rce_master.leadership.core.LEADERSHIP_LIFE,
    ),
    Cycle(
        "Robot session",
        "robot-session",
        "A robot at the master, by its connection to a robot task set.",
        rce_master.state.lifecycle.ROBOT_LIFE,
    ),
    Cycle(
        "Connection of a client",
        "connection",
        "What `on_state` of a [`Connection`](connection.md) is told.",
        rce_client.life.CONNECTION_LIFE,
    ),
    Cycle(
        "Goal of an action",
        "goal",
        "As the action's server sees it, and `actionlib_msgs/GoalStatus` names it.",
        rce.ros.actions.states.GOAL_LIFE,
    ),
    Cycle(
        "Robot of the fleet planner",
        "fleet-robot",
        "A robot as the planner sees it.",
        rce_fleet.coordination.robot.ROBOT_LIFE,
    ),
    Cycle(
        "Task of the fleet",
        "fleet-task",
        "What `GET /api/v1/tasks` shows. [Tasks of a fleet](tasks.md) describes what leads to each.",
        rce_fleet.tasks.task.TASK_LIFE,
    ),
    Cycle(
        "Move client",
        "move-client",
        "The node that sends one robot along its cells.",
        rce_fleet.coordination.move_client.CLIENT_LIFE,
    ),
    Cycle(
        "Navigation of a robot",
        "move-base",
        "What `move_base` does with a goal.",
        rce_fleet.navigation.move_base.core.MOVE_BASE,
    ),
)


def page() -> str:
    """Return the page."""
    return "\n".join([HEAD, *(line for cycle in CYCLES for line in section(cycle))]) + "\n"


def pictures() -> dict[str, str]:
    """Return the pictures, by their paths in the project."""
    return {f"{IMAGES}/{cycle.name}.svg": draw(cycle.life.table) for cycle in CYCLES}


def section(cycle: Cycle) -> Iterator[str]:
    """Return the part of the page that describes a life cycle."""
    table = cycle.life.table
    events = {event: None for row in table.values() for event in row}
    yield f"\n## {cycle.title}\n\n{cycle.text}\n"
    yield f"![The life cycle of a {cycle.life.subject}](../images/lifecycles/{cycle.name}.svg)\n"
    yield "| state | meaning | event → next state |\n|---|---|---|"
    for state, row in table.items():
        leads = ", ".join(f"{word(event)} → {word(after)}" for event, after in row.items())
        yield f"| **{word(state)}** | {meaning(state)} | {leads or 'an end'} |"
    yield "\n| event | meaning |\n|---|---|"
    for event in events:
        yield f"| **{word(event)}** | {meaning(event)} |"


def meaning(member: Enum) -> str:
    """Return the docstring of a member of an enum.

    Raises:
        LookupError: It does not have one.
    """
    doc = _module(type(member).__module__)[f"{type(member).__qualname__}.{member.name}"].docstring
    if doc is None:
        raise LookupError(f"{type(member).__module__}.{member} has no docstring; say there what it means")
    return _ROLE.sub(r"`\1`", " ".join(doc.value.split())).replace("``", "`")


@cache
def _module(name: str) -> griffe.Module:
    """Read one module; ``griffe.load`` would read its whole package."""
    path = Path(str(sys.modules[name].__file__))
    return griffe.visit(name.rpartition(".")[2], filepath=path, code=path.read_text(encoding="utf-8"))
