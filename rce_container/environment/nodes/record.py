"""What is known of one node of a container, and what follows from that alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rce.control.model import NodeState, NodeStatus
from rce.lifecycle import StateMachine
from rce.model.specs import NodeSpec, RestartPolicy
from rce_container.environment.nodes.life import NODE_LIFE, WITH_PROCESS, LifeEvent

WELL_S = 30.0
"""A node that ran well for so long starts at the first pause again, and its restarts count anew."""
LAST_CHANCE_S = 0.25
"""How long a stuck node is seen to be so, and may still give a sign, before it is ended."""


@dataclass(slots=True)
class Node:
    """What is known of one node."""

    spec: NodeSpec
    """What its newest life was launched with, or with what it is to be."""
    desired: NodeSpec | None
    life: int = 0
    pid: int = 0
    exit_code: int | None = None
    detail: str = ""
    restarts: int = 0
    in_a_row: int = 0
    """How often it was started again since it ran well last."""
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
    """When it was taken for stuck."""
    silent_at: float = math.inf
    """When it is taken for stuck, unless a heartbeat comes before."""
    share: float = 1.0
    told: str = ""
    """The last failure that the user was told of."""
    course: StateMachine[NodeState, LifeEvent] = field(init=False)

    def __post_init__(self) -> None:
        self.course = NODE_LIFE.start(NodeState.WAITING, self.spec.tag)

    @property
    def state(self) -> NodeState:
        """Where it is in its life."""
        return self.course.state

    @property
    def has_process(self) -> bool:
        """Whether a process of it is there, or is being made."""
        return self.state in WITH_PROCESS

    @property
    def is_leaving(self) -> bool:
        """Whether its process is to end though it does well."""
        return self.has_process and (self.desired is None or _command(self.desired) != _command(self.spec))

    @property
    def is_ready(self) -> bool:
        """Whether nodes that come after it may start."""
        return self.state is NodeState.RUNNING or self.is_done

    @property
    def beats(self) -> bool:
        """Whether a silence of its heartbeat would mean something."""
        return bool(self.spec.heartbeat) and self.state in (NodeState.STARTING, NodeState.RUNNING)

    def ran_well(self, now: float) -> bool:
        """Whether its newest life was long enough for its restarts to count anew."""
        return min(now, self.ill_at) - self.started_at >= WELL_S

    def is_given_up(self, now: float) -> bool:
        """Whether it is stuck, and is to be ended for that."""
        return (
            self.state is NodeState.STUCK
            and not self.is_leaving
            and self.restarts_after(failed=True)
            and now >= self.ill_at + LAST_CHANCE_S
        )

    def restarts_after(self, *, failed: bool) -> bool:
        """Whether its policy has it started again after an end of that kind."""
        policy = self.spec.restart
        return policy is RestartPolicy.ALWAYS or (failed and policy is RestartPolicy.ON_FAILURE)

    def status(self) -> NodeStatus:
        """What is reported of it."""
        return NodeStatus(
            tag=self.spec.tag,
            state=self.state,
            pid=self.pid,
            exit_code=self.exit_code,
            restarts=self.restarts,
            detail=self.detail,
        )


def _command(spec: NodeSpec) -> tuple[str, ...]:
    """All of a specification that a process is made with."""
    return spec.pkg, spec.exe, spec.args, spec.name, spec.namespace
