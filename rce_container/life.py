"""The life cycle of a container in its manager: phases, the events of each, and the transitions.

The master's states requested, placed and lost are before and between the incarnations that a manager sees.
"""

from __future__ import annotations

from enum import Enum

from rce.lifecycle import LifeCycle


class Phase(Enum):
    """The phases of a container."""

    STARTING = "starting"
    """Its processes are being made, or its environment has not reported yet."""
    RUNNING = "running"
    """Its environment reports no fault."""
    DEGRADED = "degraded"
    """Its environment reports a node that failed, is stuck, or pauses after a failure."""
    STOPPING = "stopping"
    """It is ending, because it is not desired any more; it is removed completely."""
    CLEANING = "cleaning"
    """It ended although it is desired; its remains are being removed."""
    WAITING = "waiting"
    """It is removed, and created again after a pause."""
    GONE = "gone"
    """It is removed and not desired. The manager forgets it."""


class LifeEvent(Enum):
    """What can happen to a container."""

    REPORT = "report"
    """Its environment reported no fault."""
    ILLNESS = "illness"
    """Its environment reported a fault of a node."""
    LOSS = "loss"
    """Its environment is gone."""
    NOT_STARTED = "not started"
    """It could not be started, and is removed."""
    REMOVED = "removed"
    """No process and no folder of it is left."""
    RELEASE = "release"
    """It is not desired any more."""
    DESIRE = "desire"
    """It is desired, with the same or another specification."""
    DUE = "due"
    """It waited long enough."""


CONTAINER_LIFE: LifeCycle[Phase, LifeEvent] = LifeCycle(
    "container",
    {
        Phase.STARTING: {
            LifeEvent.REPORT: Phase.RUNNING,
            LifeEvent.ILLNESS: Phase.DEGRADED,
            LifeEvent.LOSS: Phase.CLEANING,
            LifeEvent.NOT_STARTED: Phase.WAITING,
            LifeEvent.RELEASE: Phase.STOPPING,
            LifeEvent.DESIRE: Phase.STARTING,
        },
        Phase.RUNNING: {
            LifeEvent.REPORT: Phase.RUNNING,
            LifeEvent.ILLNESS: Phase.DEGRADED,
            LifeEvent.LOSS: Phase.CLEANING,
            LifeEvent.RELEASE: Phase.STOPPING,
            LifeEvent.DESIRE: Phase.RUNNING,
        },
        Phase.DEGRADED: {
            LifeEvent.REPORT: Phase.RUNNING,
            LifeEvent.ILLNESS: Phase.DEGRADED,
            LifeEvent.LOSS: Phase.CLEANING,
            LifeEvent.RELEASE: Phase.STOPPING,
            LifeEvent.DESIRE: Phase.DEGRADED,
        },
        Phase.STOPPING: {
            LifeEvent.REPORT: Phase.STOPPING,
            LifeEvent.ILLNESS: Phase.STOPPING,
            LifeEvent.LOSS: Phase.STOPPING,
            LifeEvent.REMOVED: Phase.GONE,
            LifeEvent.NOT_STARTED: Phase.GONE,
            LifeEvent.RELEASE: Phase.STOPPING,
            LifeEvent.DESIRE: Phase.STOPPING,
        },
        Phase.CLEANING: {
            LifeEvent.REPORT: Phase.CLEANING,
            LifeEvent.ILLNESS: Phase.CLEANING,
            LifeEvent.REMOVED: Phase.WAITING,
            LifeEvent.RELEASE: Phase.STOPPING,
            LifeEvent.DESIRE: Phase.CLEANING,
        },
        Phase.WAITING: {
            LifeEvent.DUE: Phase.STARTING,
            LifeEvent.RELEASE: Phase.GONE,
            LifeEvent.DESIRE: Phase.WAITING,
        },
        Phase.GONE: {
            LifeEvent.DESIRE: Phase.STARTING,
            LifeEvent.RELEASE: Phase.GONE,
        },
    },
)

ALIVE = frozenset({Phase.RUNNING, Phase.DEGRADED})
"""The phases in which a container's environment reports, and is to continue."""
