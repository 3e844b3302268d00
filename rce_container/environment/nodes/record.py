"""The record of one node of a container, and the facts that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rce.control import NodeState, NodeStatus
from rce.lifecycle import StateMachine
from rce.model import NodeSpec, RestartPolicy
from rce_container.environment.nodes.life import NODE_LIFE, WITH_PROCESS, LifeEvent

WELL_S = 30.0
"""A node that ran well for this long starts at the first delay again, with its count of restarts at 0."""
LAST_CHANCE_S = 0.25
"""How long a node is reported as stuck, and may still send a heartbeat, before it is ended."""


@dataclass(slots=True)
class Node:
    """The record of one node."""

    spec: NodeSpec
    """The specification that its newest life was launched with, or is to be launched with."""
    desired: NodeSpec | None
    life: int = 0
    pid: int = 0
    exit_code: int | None = None
    detail: str = ""
    restarts: int = 0
    in_a_row: int = 0
    """How often it was restarted since it last ran well."""
    pausing: bool = False
    """It ended, and waits for :attr:`due`."""
    failing: bool = False
    """Its last end was a failure, or it is being ended because it is stuck."""
    is_done: bool = False
    """Its last life ended with exit code 0."""
    due: float = 0.0
    """When it may be started again."""
    started_at: float = 0.0
    registered_at: float | None = None
    ill_at: float = math.inf
    """When it was found stuck."""
    silent_at: float = math.inf
    """When it counts as stuck, unless a heartbeat arrives before."""
    share: float = 1.0
    restoring: bool = False
    """Its newest life has yet to get the state that was kept for it, or to learn that there is none."""
    unrestored: bool = False
    """Its newest life did not get the state that was kept for it."""
    state_fault: str = ""
    """Why its state is not restored or saved."""
    told: str = ""
    """The last failure that was reported to the user."""
    course: StateMachine[NodeState, LifeEvent] = field(init=False)

    def __post_init__(self) -> None:
        self.course = NODE_LIFE.start(NodeState.WAITING, self.spec.tag)

    @property
    def state(self) -> NodeState:
        """Its state."""
        return self.course.state

    @property
    def has_process(self) -> bool:
        """Whether it has a process, or a process is being started."""
        return self.state in WITH_PROCESS

    @property
    def is_leaving(self) -> bool:
        """Whether its process is to end although it has not failed."""
        return self.has_process and (self.desired is None or _command(self.desired) != _command(self.spec))

    @property
    def is_ready(self) -> bool:
        """Whether nodes that come after it may start."""
        return (self.state is NodeState.RUNNING and not self.restoring) or self.is_done

    @property
    def is_unregistered(self) -> bool:
        """Whether its process has not registered with the ROS core yet."""
        return self.state is NodeState.STARTING and self.registered_at is None

    @property
    def beats(self) -> bool:
        """Whether a missing heartbeat counts."""
        return bool(self.spec.heartbeat) and self.state in (NodeState.STARTING, NodeState.RUNNING)

    def ran_well(self, now: float) -> bool:
        """Whether its newest life was long enough to reset the count of restarts."""
        return min(now, self.ill_at) - self.started_at >= WELL_S

    def is_given_up(self, now: float) -> bool:
        """Whether it is to be ended because it is stuck."""
        return (
            self.state is NodeState.STUCK
            and not self.is_leaving
            and self.restarts_after(failed=True)
            and now >= self.ill_at + LAST_CHANCE_S
        )

    def restarts_after(self, *, failed: bool) -> bool:
        """Whether its restart policy covers an end of this kind."""
        policy = self.spec.restart
        return policy is RestartPolicy.ALWAYS or (failed and policy is RestartPolicy.ON_FAILURE)

    def status(self) -> NodeStatus:
        """Return its status."""
        return NodeStatus(
            tag=self.spec.tag,
            state=self.state,
            pid=self.pid,
            exit_code=self.exit_code,
            restarts=self.restarts,
            detail="; ".join(filter(None, (self.detail, self.state_fault))),
        )


def _command(spec: NodeSpec) -> tuple[object, ...]:
    """Return the parts of a specification that determine its process.

    The services of its state are among them: a process that was not restored must not be saved.
    """
    return spec.pkg, spec.exe, spec.args, spec.name, spec.namespace, spec.state_services
