"""The life cycles of a robot's session, a container, and a move with volumes, each a transition table."""

from __future__ import annotations

from enum import Enum

from rce.lifecycle import LifeCycle
from rce_master.exceptions import TransitionError


class RobotSession(Enum):
    """The states of a robot."""

    OFFLINE = "offline"
    """The robot is unknown; it has no endpoint."""
    CONNECTED = "connected"
    """A task set holds its WebSocket connection."""
    ABSENT = "absent"
    """Its connection dropped, or its task set is away; its endpoint is kept for the grace time."""


class RobotEvent(Enum):
    """What can happen to a robot."""

    LOGIN = "login"
    """It logged in, or its task set came back with it still connected."""
    LEAVE = "leave"
    """Its connection ended, or its task set went away."""
    EXPIRE = "expire"
    """The grace time is over."""


class ContainerPhase(Enum):
    """The states of a container."""

    REQUESTED = "requested"
    """Desired, and placed nowhere yet."""
    PLACED = "placed"
    """A task set was ordered to create it, and has not reported it yet."""
    STARTING = "starting"
    """Its task set is making it."""
    RUNNING = "running"
    """Its task set reports no fault."""
    DEGRADED = "degraded"
    """It runs, but a node of it failed, is stuck, or pauses after a failure."""
    FAILED = "failed"
    """It ended, or could not be made; its task set makes it again."""
    STOPPING = "stopping"
    """Its task set is ending it."""
    STOPPED = "stopped"
    """Its task set ended it, as when that is shut down; it is placed again when there is a machine."""
    LOST = "lost"
    """Its task set was away for longer than the grace time. It is placed again when there is a machine; if
    its task set returns with it first, it stays there."""

    @property
    def is_placed(self) -> bool:
        """Whether a task set is responsible for it."""
        return self not in (ContainerPhase.REQUESTED, ContainerPhase.STOPPED, ContainerPhase.LOST)


class ContainerEvent(Enum):
    """What can happen to a container."""

    PLACE = "place"
    """A task set is ordered to create it."""
    STARTING = "starting"
    """Its task set reports that it starts."""
    RUNNING = "running"
    """Its task set reports that it runs."""
    DEGRADED = "degraded"
    """Its task set reports a fault of a node."""
    FAILED = "failed"
    """Its task set reports that it ended, or could not be made."""
    STOPPING = "stopping"
    """Its task set reports that it is being ended."""
    WITHDRAW = "withdraw"
    """Its task set ended it though it is desired."""
    LOSE = "lose"
    """Its task set was away for longer than the grace time."""


class VolumeMovePhase(Enum):
    """The states of a container that moves with its volumes."""

    STOPPING = "stopping"
    """Its machine ends it, so that its files are closed."""
    SAVING = "saving"
    """Its machine sends its volumes to the master. Or it was lost, and their last snapshots are used."""
    RESTORING = "restoring"
    """The next machine makes the files of the snapshots."""
    RESTING = "resting"
    """A container without a machine could not be restored on one; one is searched for after a pause."""
    DONE = "done"
    """There is no move: the container belongs to its machine, the next one or the former one."""


class VolumeMoveEvent(Enum):
    """What can happen to such a move."""

    BEGIN = "begin"
    """An operator moves the container, or empties its machine."""
    RESTORE = "restore"
    """Its machine is lost, and another one can have it."""
    STOPPED = "stopped"
    """The container has ended."""
    SAVED = "saved"
    """The masters hold a snapshot of each of its volumes."""
    RESTORED = "restored"
    """The next machine holds the files of all volumes."""
    GIVE_UP = "give up"
    """It failed, or is not wanted any more; the container stays at its machine."""
    FAIL = "fail"
    """It failed, and the container has no machine to stay at."""
    RETRY = "retry"
    """The pause is over."""


ROBOT_LIFE: LifeCycle[RobotSession, RobotEvent] = LifeCycle(
    "robot",
    {
        RobotSession.OFFLINE: {
            RobotEvent.LOGIN: RobotSession.CONNECTED,
        },
        RobotSession.CONNECTED: {
            RobotEvent.LEAVE: RobotSession.ABSENT,
        },
        RobotSession.ABSENT: {
            RobotEvent.LOGIN: RobotSession.CONNECTED,
            RobotEvent.EXPIRE: RobotSession.OFFLINE,
        },
    },
    error=TransitionError,
)

_REPORTED: dict[ContainerEvent, ContainerPhase] = {
    ContainerEvent.PLACE: ContainerPhase.PLACED,
    ContainerEvent.STARTING: ContainerPhase.STARTING,
    ContainerEvent.RUNNING: ContainerPhase.RUNNING,
    ContainerEvent.DEGRADED: ContainerPhase.DEGRADED,
    ContainerEvent.FAILED: ContainerPhase.FAILED,
    ContainerEvent.STOPPING: ContainerPhase.STOPPING,
    ContainerEvent.WITHDRAW: ContainerPhase.STOPPED,
    ContainerEvent.LOSE: ContainerPhase.LOST,
}

CONTAINER_LIFE: LifeCycle[ContainerPhase, ContainerEvent] = LifeCycle(
    "container",
    {
        ContainerPhase.REQUESTED: {ContainerEvent.PLACE: ContainerPhase.PLACED},
        ContainerPhase.PLACED: _REPORTED,
        ContainerPhase.STARTING: _REPORTED,
        ContainerPhase.RUNNING: _REPORTED,
        ContainerPhase.DEGRADED: _REPORTED,
        ContainerPhase.FAILED: _REPORTED,
        ContainerPhase.STOPPING: _REPORTED,
        ContainerPhase.STOPPED: {ContainerEvent.PLACE: ContainerPhase.PLACED},
        ContainerPhase.LOST: {ContainerEvent.PLACE: ContainerPhase.PLACED},
    },
    error=TransitionError,
)

VOLUME_MOVE_LIFE: LifeCycle[VolumeMovePhase, VolumeMoveEvent] = LifeCycle(
    "move with volumes",
    {
        VolumeMovePhase.DONE: {
            VolumeMoveEvent.BEGIN: VolumeMovePhase.STOPPING,
            VolumeMoveEvent.RESTORE: VolumeMovePhase.RESTORING,
        },
        VolumeMovePhase.STOPPING: {
            VolumeMoveEvent.STOPPED: VolumeMovePhase.SAVING,
            VolumeMoveEvent.GIVE_UP: VolumeMovePhase.DONE,
        },
        VolumeMovePhase.SAVING: {
            VolumeMoveEvent.SAVED: VolumeMovePhase.RESTORING,
            VolumeMoveEvent.GIVE_UP: VolumeMovePhase.DONE,
        },
        VolumeMovePhase.RESTORING: {
            VolumeMoveEvent.RESTORED: VolumeMovePhase.DONE,
            VolumeMoveEvent.GIVE_UP: VolumeMovePhase.DONE,
            VolumeMoveEvent.FAIL: VolumeMovePhase.RESTING,
        },
        VolumeMovePhase.RESTING: {
            VolumeMoveEvent.RETRY: VolumeMovePhase.DONE,
            VolumeMoveEvent.GIVE_UP: VolumeMovePhase.DONE,
        },
    },
    error=TransitionError,
)
