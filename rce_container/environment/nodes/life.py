"""The life cycle of a node: its states, the events of each, and the transitions.

:class:`rce.control.model.NodeState` describes each state. A node has a process exactly while it
is starting, running, stuck or stopping. A node that is not desired any more is forgotten as soon as it has no
process.
"""

from __future__ import annotations

from enum import Enum

from rce.control.model import NodeState
from rce.lifecycle import LifeCycle


class LifeEvent(Enum):
    """What can happen to a node."""

    LAUNCH = "launch"
    """Its turn came: a process of it is being made."""
    REGISTER = "register"
    """It registered with the container's ROS core."""
    SILENCE = "silence"
    """Its heartbeat stays away."""
    BEAT = "beat"
    """Its heartbeat is there again."""
    HALT = "halt"
    """It is told to end: it is not desired any more, is another one now, or is stuck."""
    DONE = "done"
    """It ended with exit code 0, and stays so."""
    FAIL = "fail"
    """It could not be started or ended in another way, and stays so."""
    PAUSE = "pause"
    """It ended, and is started again later."""
    RENEW = "renew"
    """It ended for good, and is another one now."""


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
