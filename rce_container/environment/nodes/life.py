"""The life of a node: its states, what may happen in each, and what follows.

What each state means is said at :class:`rce.control.model.NodeState`. A node has a process exactly while it
is starting, running, stuck or stopping. One that is not desired any more is forgotten as soon as it has none.
"""

from __future__ import annotations

from enum import Enum

from rce.control.model import NodeState


class Happening(Enum):
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
    """It ended by itself with exit code 0, and stays so."""
    FAIL = "fail"
    """It could not be started or ended in another way, and stays so."""
    PAUSE = "pause"
    """It ended, and is started again later."""
    RENEW = "renew"
    """It ended for good, and is another one now."""


NEXT: dict[NodeState, dict[Happening, NodeState]] = {
    NodeState.WAITING: {
        Happening.LAUNCH: NodeState.STARTING,
        Happening.RENEW: NodeState.WAITING,
    },
    NodeState.STARTING: {
        Happening.REGISTER: NodeState.RUNNING,
        Happening.SILENCE: NodeState.STUCK,
        Happening.HALT: NodeState.STOPPING,
        Happening.DONE: NodeState.EXITED,
        Happening.FAIL: NodeState.FAILED,
        Happening.PAUSE: NodeState.WAITING,
    },
    NodeState.RUNNING: {
        Happening.SILENCE: NodeState.STUCK,
        Happening.HALT: NodeState.STOPPING,
        Happening.DONE: NodeState.EXITED,
        Happening.FAIL: NodeState.FAILED,
        Happening.PAUSE: NodeState.WAITING,
    },
    NodeState.STUCK: {
        Happening.BEAT: NodeState.RUNNING,
        Happening.HALT: NodeState.STOPPING,
        Happening.DONE: NodeState.EXITED,
        Happening.FAIL: NodeState.FAILED,
        Happening.PAUSE: NodeState.WAITING,
    },
    NodeState.STOPPING: {
        Happening.FAIL: NodeState.FAILED,
        Happening.PAUSE: NodeState.WAITING,
    },
    NodeState.EXITED: {
        Happening.RENEW: NodeState.WAITING,
    },
    NodeState.FAILED: {
        Happening.RENEW: NodeState.WAITING,
    },
}

WITH_PROCESS = frozenset(state for state, row in NEXT.items() if Happening.PAUSE in row)
"""The states in which a node has a process."""


def after(state: NodeState, happening: Happening) -> NodeState:
    """The state that follows.

    Raises:
        ValueError: This cannot happen in that state.
    """
    found = NEXT[state].get(happening)
    if found is None:
        raise ValueError(f"{happening.value} cannot happen to a node that is {state.value}")
    return found
