"""Robots: login, absence, the end of the grace time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import EndpointState, EndpointStatus, TaskSetKind
from rce.model import EndpointId
from rce_master.exceptions import (
    ConflictError,
    ForbiddenError,
    InvalidRequestError,
    LimitReachedError,
    NotFoundError,
)
from rce_master.state import activity, endpoints
from rce_master.state.lifecycle import RobotEvent, RobotSession
from rce_master.state.records import Lockout, Robot, RobotLive
from rce_master.state.tables import WAITING

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import RobotLeft, RobotLogin
    from rce_master.state.records import TaskSet
    from rce_master.state.tables import Tables

DRAINED = "this robot process is being emptied; connect again"
"""What robots of a drained task set are told."""
_SENDING_AWAY = 50
"""The work of sending a robot away, as :attr:`StateSettings.max_work` counts it; then of noting that it left,
and of forgetting one of its interfaces or connections that is in use."""
_LEAVING = 10
_FORGETTING = 3


def login(tx: Transaction, command: RobotLogin) -> None:
    """Let a robot in at a task set."""
    try:
        name = EndpointId.parse(command.id)
    except ValueError as error:
        raise InvalidRequestError(str(error)) from None
    user = tx.tables.users.get(name.user)
    if user is None:
        raise NotFoundError(f"there is no user {name.user!r}")
    if not user.role.changes:
        raise ForbiddenError(f"user {user.name!r} has the role {user.role.value}, which connects no robots")
    if command.credential and command.credential not in tx.tables.tokens:
        raise ForbiddenError("the robot's token was revoked")
    if command.password and command.password != user.password:
        raise ForbiddenError("the password was changed")
    task_set = tx.tables.task_sets.get(command.process)
    if (
        task_set is None
        or task_set.kind is not TaskSetKind.ROBOT
        or not tx.tables.is_connected(command.process)
    ):
        raise ConflictError(f"{command.process!r} is not a connected robot task set")
    there = tx.tables.endpoints.get(command.id)
    if there is None:
        _new(tx, name)
    elif not isinstance(there, Robot):
        raise ConflictError(
            f"{name.tag!r} is a container of user {name.user!r}; a robot needs another robotID"
        )
    else:
        _settle(tx, there)
    _enter(tx, command)
    tx.changes.answered = command.id
    tx.happen("robot_connected", command.id, f"at {command.process}")


def _new(tx: Transaction, name: EndpointId) -> None:
    if tx.tables.endpoints.count("robots_of", name.user) >= tx.settings.max_robots:
        raise LimitReachedError(f"user {name.user!r} has {tx.settings.max_robots} robots already")
    tx.put(Robot(id=str(name)))
    tx.put(RobotLive(id=str(name), session=RobotSession.OFFLINE, since=tx.now))
    tx.touch(str(name))


def _enter(tx: Transaction, command: RobotLogin) -> None:
    id_, process = command.id, command.process
    robot = tx.tables.robot(id_)
    assert robot is not None
    live = tx.tables.robot_live(id_)
    if live.session is RobotSession.CONNECTED:
        client = live.status.client if live.status is not None else ""
        where = f", from {client}" if client else ""
        raise ConflictError(
            f"robot {robot.tag!r} is connected already{where}; a robotID can be used once at a time"
        )
    if robot.task_set != process:
        if robot.task_set:
            endpoints.withdraw(tx, robot, "the robot connected elsewhere")
        endpoints.assign(tx, robot, process)
        endpoints.touch_dialers(tx, id_)
    elif not command.credential and _is_before(tx.tables, robot):
        endpoints.assign(tx, robot, process)  # it came in by its token before, and now by the new password
    tx.put(replace(tx.tables.endpoints[id_], credential=command.credential))
    tx.put(replace(live.after(RobotEvent.LOGIN, tx.now), status=None))
    activity.forget(tx, id_)


def left(tx: Transaction, command: RobotLeft) -> None:
    """Note that a robot's connection ended."""
    robot = tx.tables.robot(command.id)
    if robot is not None and robot.task_set == command.process:
        leave(tx, robot, command.reason)


def leave(tx: Transaction, robot: Robot, reason: str) -> None:
    """Begin a robot's grace time."""
    live = tx.tables.robot_live(robot.id)
    if live.session is RobotSession.CONNECTED:
        tx.put(replace(live.after(RobotEvent.LEAVE, tx.now), status=None))
        activity.forget(tx, robot.id)
        tx.happen("robot_left", robot.id, reason)


def leave_lost(tx: Transaction) -> None:
    """Begin the grace time of robots whose task sets went away."""
    for presence in [one for one in tx.tables.presence if one.leaving]:
        for robot in tx.tables.endpoints.by("task_set", presence.process):
            assert isinstance(robot, Robot)
            if tx.tables.robot_live(robot.id).session is not RobotSession.CONNECTED:
                continue
            if tx.is_out_of_work():
                return
            tx.spend(_leaving_work(tx.tables, robot.id))
            _leave_lost(tx, robot)
        tx.put(replace(presence, leaving=False))


def _leave_lost(tx: Transaction, robot: Robot) -> None:
    leave(tx, robot, f"its task set {robot.task_set!r} is away")


def _leaving_work(tables: Tables, id_: str) -> int:
    return _LEAVING + _FORGETTING * (
        tables.active.count("endpoint", id_) + tables.open_ends.count("endpoint", id_)
    )


def why_locked_out(tables: Tables, robot: Robot) -> str:
    """Return why a robot's session has ended, or is about to, because of its user; empty if it has not."""
    user = tables.users[robot.user]
    if not robot.task_set:
        return ""
    if not user.role.changes:
        return f"the user's role is {user.role.value} now"
    return "the password was changed" if not robot.credential and _is_before(tables, robot) else ""


def _is_before(tables: Tables, robot: Robot) -> bool:
    """Tell whether the present task set became responsible for a robot before the password was changed."""
    return robot.epoch < tables.users[robot.user].password_epoch


def lock_out(tx: Transaction, user: str) -> None:
    """Send those of a user's robots away whose sessions are to end."""
    tx.put(Lockout(user=user))
    send_away_locked_out(tx)


def send_away_locked_out(tx: Transaction) -> None:
    """Send robots away that are locked out.

    After a restart of the master it is done when their task sets report them.
    """
    for lockout in list(tx.tables.lockouts):
        for robot in tx.tables.robots(lockout.user):
            if not (reason := why_locked_out(tx.tables, robot)):
                continue
            if tx.is_out_of_work():
                return
            tx.spend(_SENDING_AWAY + _leaving_work(tx.tables, robot.id))
            send_away(tx, robot, reason)
        tx.delete(tx.tables.lockouts, lockout.user)


def _settle(tx: Transaction, robot: Robot) -> None:
    """Do for a robot what is left to later commands, so that it can log in."""
    if reason := why_locked_out(tx.tables, robot):
        send_away(tx, robot, reason)
    elif robot.task_set and not tx.tables.is_connected(robot.task_set):
        _leave_lost(tx, robot)


def send_away(tx: Transaction, robot: Robot, reason: str, *, elsewhere: bool = False) -> None:
    """End a robot's session. It is absent then, and finds everything again if it can log in again in time.

    Args:
        tx: The transaction.
        robot: The robot.
        reason: For the robot and for its user.
        elsewhere: Whether it is to connect again, at another task set.
    """
    leave(tx, robot, reason)
    if robot.task_set:
        endpoints.withdraw(tx, robot, reason, elsewhere=elsewhere)
        tx.put(replace(robot, task_set=""))
        tx.touch(robot.id)
        endpoints.touch_dialers(tx, robot.id)


def open_task_sets(tables: Tables) -> list[TaskSet]:
    """Return the robot task sets that take robots: those that are connected and not drained."""
    return [
        one
        for one in tables.task_sets
        if one.kind is TaskSetKind.ROBOT
        and tables.is_connected(one.process)
        and one.process not in tables.drains
    ]


def empty_drained(tx: Transaction) -> None:
    """Send the robots of drained task sets elsewhere; they stay while no task set takes them."""
    if not tx.tables.drains or not open_task_sets(tx.tables):
        return
    for drain in tx.tables.drains:
        task_set = tx.tables.task_sets.get(drain.process)
        if task_set is None or task_set.kind is not TaskSetKind.ROBOT:
            continue
        for robot in tx.tables.endpoints.by("task_set", drain.process):
            assert isinstance(robot, Robot)
            if tx.is_out_of_work():
                return
            tx.spend(_SENDING_AWAY + _leaving_work(tx.tables, robot.id))
            send_away(tx, robot, DRAINED, elsewhere=True)


def reported(tx: Transaction, robot: Robot, status: EndpointStatus) -> None:
    """Note what its task set reports of a robot beside its interfaces and connections."""
    live = tx.tables.robot_live(robot.id)
    if status.state is EndpointState.RUNNING and live.session is RobotSession.ABSENT:
        live = live.after(RobotEvent.LOGIN, tx.now)
        tx.happen("robot_connected", robot.id, f"still at {robot.task_set}")
    elif status.state is EndpointState.ABSENT and live.session is RobotSession.CONNECTED:
        if live.status is None:
            # It was let in a moment ago, and its task set has not heard of it yet.
            return
        leave(tx, robot, status.detail)
        live = tx.tables.robot_live(robot.id)
    tx.put(replace(live, status=status))


def reported_elsewhere(tx: Transaction, process: str, status: EndpointStatus) -> None:
    """Have a task set drop a robot that it reports as connected, and that is not placed there.

    It was sent away while the answer to its login was under way, so its task set made it afterwards.
    """
    if status.state is EndpointState.RUNNING:
        tx.withdraw(process, status.id, "the robot was sent away while it logged in; connect again")


def expire(tx: Transaction) -> None:
    """Remove the robots whose grace time is over, and give up those that were let in and never came."""
    for live in tx.tables.live.by("unsettled", WAITING):
        robot = tx.tables.robot(live.id)
        assert robot is not None
        assert isinstance(live, RobotLive)
        waited = tx.now - live.since
        if live.session is RobotSession.ABSENT and waited >= tx.settings.robot_grace:
            if tx.is_out_of_work():
                return
            tx.spend(endpoints.removal_work(tx.tables, robot.id))
            live.after(RobotEvent.EXPIRE, tx.now)  # it is checked, and nothing is left to record
            endpoints.remove(tx, robot.id, "the robot stayed away")
            tx.happen("robot_gone", robot.id, "its interfaces and connections were removed")
        elif live.status is None and waited >= tx.settings.login_timeout:
            leave(tx, robot, "it was let in and never came")
