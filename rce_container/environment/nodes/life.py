"""The life cycle of a node: its states, the events of each, and the transitions.

:class:`rce.control.model.NodeState` describes each state. A node has a process exactly while it
is starting, running, stuck or stopping. A node that is not desired any more is forgotten as soon as it has no
process.
"""

from __future__ import annotations

from enum import Enum

from rce.control import NodeState
from rce.lifecycle import LifeCycle


class LifeEvent(Enum):
    """What can happen to a node."""

    LAUNCH = "launch"
    """A process of it is being started."""
    REGISTER = "register"
    """It registered with the container's ROS core."""
    SILENCE = "silence"
    """Its heartbeat is missing."""
    BEAT = "beat"
    """Its heartbeat came again."""
    HALT = "halt"
    """It is ordered to end: it is not desired any more, was changed, or is stuck."""
    DONE = "done"
    """It ended with exit code 0, and is not started again."""
    FAIL = "fail"
    """It could not be started or failed, and is not started again."""
    PAUSE = "pause"
    """It ended, and is started again later."""
    RENEW = "renew"
    """It ended, and a changed node takes its place."""


NODE_LIFE: LifeCycle[NodeState, LifeEvent] = LifeCycle(
    "node",
    {
        NodeState.WAITING: {
            LifeEvent.LAUNCH: NodeState.STARTING,
            LifeEvent.RENEW: NodeState.WAITING,
        },
        NodeState.STARTING: {
            LifeEvent.REGISTER: NodeState.RUNNING,
            LifeEvent.SILENCE: NodeState.STUCK,
            LifeEvent.HALT: NodeState.STOPPING,
            LifeEvent.DONE: NodeState.EXITED,
            LifeEvent.FAIL: NodeState.FAILED,
            LifeEvent.PAUSE: NodeState.WAITING,
        },
        NodeState.RUNNING: {
            LifeEvent.SILENCE: NodeState.STUCK,
            LifeEvent.HALT: NodeState.STOPPING,
            LifeEvent.DONE: NodeState.EXITED,
            LifeEvent.FAIL: NodeState.FAILED,
            LifeEvent.PAUSE: NodeState.WAITING,
        },
        NodeState.STUCK: {
            LifeEvent.BEAT: NodeState.RUNNING,
            LifeEvent.HALT: NodeState.STOPPING,
            LifeEvent.DONE: NodeState.EXITED,
            LifeEvent.FAIL: NodeState.FAILED,
            LifeEvent.PAUSE: NodeState.WAITING,
        },
        NodeState.STOPPING: {
            LifeEvent.FAIL: NodeState.FAILED,
            LifeEvent.PAUSE: NodeState.WAITING,
        },
        NodeState.EXITED: {
            LifeEvent.RENEW: NodeState.WAITING,
        },
        NodeState.FAILED: {
            LifeEvent.RENEW: NodeState.WAITING,
        },
    },
)

WITH_PROCESS = frozenset(state for state, row in NODE_LIFE.table.items() if LifeEvent.PAUSE in row)
"""The states in which a node has a process."""
