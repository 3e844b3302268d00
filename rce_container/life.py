"""The life cycle of a container in its manager: phases, the events of each, and the transitions.

The master's states requested, placed and lost are before and between the incarnations that a manager sees.
"""

from __future__ import annotations

from enum import Enum

from rce.lifecycle import LifeCycle


class Phase(Enum):
    """Where a container is in its life."""

    STARTING = "starting"
    """Its processes are being made, or its environment has not reported yet."""
    RUNNING = "running"
    """Its environment reports that all is well."""
    DEGRADED = "degraded"
    """Its environment reports a node that failed, is stuck, or pauses after a failure."""
    STOPPING = "stopping"
    """It was told to end, because it is not desired any more; nothing of it may be left."""
    CLEANING = "cleaning"
    """It ended although it is desired; what is left of it is being removed."""
    WAITING = "waiting"
    """Nothing of it is there; it is made again after a while."""
    GONE = "gone"
    """Nothing of it is there, and it is not desired. The manager forgets it."""


class LifeEvent(Enum):
    """What can happen to a container."""

    REPORT = "report"
    """Its environment reported that all is well."""
    ILLNESS = "illness"
    """Its environment reported that not all is well."""
    LOSS = "loss"
    """Its environment is gone."""
    NOT_STARTED = "not started"
    """It could not be started; nothing of it is there."""
    REMOVED = "removed"
    """No process and no folder of it is left."""
    RELEASE = "release"
    """It is not desired any more."""
    DESIRE = "desire"
    """It is desired, with whatever specification."""
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
