"""The manager's record of one container. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import msgspec

from rce.control import DesiredState, EndpointState, EndpointStatus, LinkAddress, ObservedStatus
from rce.lifecycle import StateMachine
from rce_container.life import ALIVE, CONTAINER_LIFE, LifeEvent, Phase


@dataclass(slots=True)
class Container:
    """The manager's record of one container."""

    id: str
    course: StateMachine[Phase, LifeEvent]
    desired: DesiredState | None = None
    """None also for an adopted container that the master has not mentioned yet."""
    drop_revision: int = 0
    incarnation_id: str = ""
    address: LinkAddress = field(default_factory=LinkAddress)
    reported: ObservedStatus | None = None
    failures: int = 0
    """How often it has ended since it was last stable."""
    running_since: float | None = None
    ticket: int = 0
    detail: str = ""
    told: str = ""
    """The last failure that was reported to the user."""
    number: int = 0
    """The number of the last report to the master."""

    @property
    def known_revision(self) -> int:
        """The newest revision that is known of it."""
        if self.desired is not None:
            return self.desired.revision
        return self.reported.header.revision if self.reported is not None else 0

    @classmethod
    def make(cls, id_: str, phase: Phase, **fields: Any) -> Self:
        """Make a record in a phase."""
        return cls(id_, CONTAINER_LIFE.start(phase, id_), **fields)

    @property
    def phase(self) -> Phase:
        """The phase of the container."""
        return self.course.state

    @property
    def status(self) -> EndpointStatus:
        """Return the status for the master."""
        if self.reported is None or self.phase not in {*ALIVE, Phase.STOPPING}:
            return self.describe(EndpointStatus(id=self.id, revision=0, state=_STATES[self.phase]))
        return self.describe(self.reported.whole)

    def describe(self, base: EndpointStatus) -> EndpointStatus:
        """Add to the environment's status the fields that it does not know."""
        state = EndpointState.STOPPING if self.phase is Phase.STOPPING else base.state
        return msgspec.structs.replace(
            base,
            id=self.id,
            revision=max(0, base.revision),
            state=state,
            incarnation=self.incarnation_id,
            address=self.address,
            detail=self.detail,
            number=self.number,
        )


_STATES = {
    Phase.STARTING: EndpointState.STARTING,
    Phase.RUNNING: EndpointState.RUNNING,
    Phase.DEGRADED: EndpointState.DEGRADED,
    Phase.STOPPING: EndpointState.STOPPING,
    Phase.CLEANING: EndpointState.FAILED,
    Phase.WAITING: EndpointState.FAILED,
    Phase.GONE: EndpointState.STOPPING,
}
