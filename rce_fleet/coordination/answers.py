"""A move client's answer on the topic of its cell lists, for graphs that share no other topic. Pure.

An answer is a ``std_msgs/Int32MultiArray`` with three parts, one for each dimension: the list's cells; the
last cell reached and the one driven to, -1 for none; and cells that the robot has found blocked. The label of
the first is ``answer=17 driving``: the list's number and the move client's state. Lists have other labels.
The label of the second tells of the robot: ``robot_age=0.2 pose=1.5,2.5,0.0``, and of the planner that sent
the list: ``planner=1790000000.000000000``, each only if it is known. A fourth part, cells that the robot saw
free again, is there only if there are such cells.
"""

from __future__ import annotations

from itertools import accumulate, pairwise
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.robot_signs import NO_SIGN, RobotPose, RobotSign
from rce_fleet.limits import MOST_REVISION

if TYPE_CHECKING:
    from collections.abc import Sequence

_MARK = "answer="
_NUMBER = "revision="
_GRID = "grid="
_SPEED = "speed="
_PLANNER = "planner="
_AGE = "robot_age="
_POSE = "pose="
_NONE = -1
_PARTS = (3, 4)


class Answer(NamedTuple):
    """A move client's answer."""

    report: ClientReport
    blocked: tuple[int, ...] = ()
    """Cells that the robot has found blocked."""
    freed: tuple[int, ...] = ()
    """Cells that the robot has seen free again."""
    sign: RobotSign = NO_SIGN
    """What the move client last heard of the robot."""
    planner: str = ""
    """Name of the planner that sent the list: when it began; empty: the list did not say it."""


def is_answer(labels: Sequence[str]) -> bool:
    """Return whether an array with these labels is an answer and not a list."""
    return bool(labels) and labels[0].startswith(_MARK)


def answer_array(answer: Answer) -> dict[str, Any]:
    """Return the fields of a ``std_msgs/Int32MultiArray`` for an answer."""
    report = answer.report
    progress = [_NONE if cell is None else cell for cell in (report.reached, report.target)]
    parts = {
        f"{_MARK}{report.revision} {report.state.value}": list(report.cells),
        _label(answer): progress,
        "blocked": list(answer.blocked),
    }
    if answer.freed:
        parts["freed"] = list(answer.freed)
    dimensions = [{"label": label, "size": len(part), "stride": len(part)} for label, part in parts.items()]
    return {"layout": {"dim": dimensions}, "data": [cell for part in parts.values() for cell in part]}


def read_answer(labels: Sequence[str], sizes: Sequence[int], data: Sequence[int]) -> Answer:
    """Read an answer.

    Args:
        labels: Labels of the array's dimensions.
        sizes: Sizes of the array's dimensions.
        data: The array's numbers.

    Raises:
        ValueError: The array has another form.
    """
    if not is_answer(labels) or len(sizes) not in _PARTS or sizes[1] != 2 or sum(sizes) != len(data):  # noqa: PLR2004
        raise ValueError(
            f"not a move client's answer: labels {list(labels)}, sizes {list(sizes)}, {len(data)} numbers"
        )
    revision, _, state = labels[0].removeprefix(_MARK).partition(" ")
    ends = accumulate(sizes, initial=0)
    cells, progress, blocked, *rest = (tuple(data[begin:end]) for begin, end in pairwise(ends))
    reached, target = (None if cell == _NONE else cell for cell in progress)
    report = ClientReport(read_revision(int(revision)), read_client_state(state), cells, reached, target)
    freed = rest[0] if rest else ()
    return Answer(report, blocked, freed, _read_sign(labels[1]), _word(labels[1], _PLANNER))


def read_client_state(text: str) -> ClientState:
    """Return the state that a move client reports.

    Raises:
        ValueError: The state is unknown.
    """
    known = {state.value: state for state in ClientState}
    if text not in known:
        raise ValueError(f"its state must be one of {', '.join(known)}, not {text!r}")
    return known[text]


def read_revision(revision: int) -> int:
    """Return the number of a list that a move client reports.

    Raises:
        ValueError: No planner has sent so many lists.
    """
    if not 0 <= revision <= MOST_REVISION:
        raise ValueError(f"the number of its list must be within 0 .. {MOST_REVISION}, not {revision}")
    return revision


def _label(answer: Answer) -> str:
    sign = answer.sign
    words = ["reached and target"]
    if sign.age is not None:
        words.append(f"{_AGE}{sign.age!r}")
    if sign.pose is not None:
        words.append(_POSE + ",".join(map(repr, sign.pose)))
    if answer.planner:
        words.append(_PLANNER + answer.planner)
    return " ".join(words)


def _read_sign(label: str) -> RobotSign:
    """Read what a label tells of the robot.

    Raises:
        ValueError: A number cannot be read.
    """
    age: float | None = None
    pose: RobotPose | None = None
    for word in label.split():
        if word.startswith(_AGE):
            age = float(word.removeprefix(_AGE))
        elif word.startswith(_POSE):
            x, y, yaw = map(float, word.removeprefix(_POSE).split(","))
            pose = x, y, yaw
    return RobotSign(age, pose)


def _word(label: str, mark: str) -> str:
    """Return what follows a mark in a label; empty without it."""
    return next((word.removeprefix(mark) for word in label.split() if word.startswith(mark)), "")


def numbered_array(
    cells: Sequence[int], revision: int, grid: str = "", speed: float = inf, planner: str = ""
) -> dict[str, Any]:
    """Return the fields of a ``std_msgs/Int32MultiArray`` for a numbered list of cells.

    Args:
        cells: The cells.
        revision: Number of the list.
        grid: Names the grid that the cells belong to; empty: not said.
        speed: Greatest speed in the cells, metres per second; infinity: not limited.
        planner: Names the planner that sends it; empty: not said.
    """
    dimensions = [{"label": f"{_NUMBER}{revision}", "size": len(cells), "stride": len(cells)}]
    if grid:
        dimensions.append({"label": f"{_GRID}{grid}", "size": 0, "stride": 0})
    if speed < inf:
        dimensions.append({"label": f"{_SPEED}{speed!r}", "size": 0, "stride": 0})
    if planner:
        dimensions.append({"label": f"{_PLANNER}{planner}", "size": 0, "stride": 0})
    return {"layout": {"dim": dimensions, "data_offset": 0}, "data": list(cells)}


def grid_of(labels: Sequence[str]) -> str:
    """Return the grid that a list belongs to; empty if it does not say."""
    return next((label.removeprefix(_GRID) for label in labels if label.startswith(_GRID)), "")


def planner_of(labels: Sequence[str]) -> str:
    """Return the planner that sent a list; empty if it does not say."""
    return next((label.removeprefix(_PLANNER) for label in labels if label.startswith(_PLANNER)), "")


def speed_of(labels: Sequence[str]) -> float:
    """Return the greatest speed that a list allows, metres per second; infinity without a limit."""
    for label in labels:
        text = label.removeprefix(_SPEED)
        if text != label:
            try:
                return float(text)
            except ValueError:
                return inf
    return inf


def revision_of(labels: Sequence[str]) -> int | None:
    """Return the number in the labels of an array's dimensions; ``None`` without one."""
    for label in labels:
        text = label.removeprefix(_NUMBER)
        if text != label and text.isdecimal():
            return int(text)
    return None
