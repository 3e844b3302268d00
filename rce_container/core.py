"""The manager's decisions: events in, instructions out. Pure: no I/O, no clock, no task.

A container has several incarnations, one after the other, each with its own id. Events of an ended
incarnation are ignored.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import assert_never

import msgspec

from rce.aio.backoff import Backoff
from rce.control import (
    DesiredState,
    EndpointSpec,
    EndpointState,
    EndpointStatus,
    Fault,
    Fit,
    Gone,
    LinkAddress,
    ObservedStatus,
    PatchStatus,
    SpecPatch,
    SpecWanted,
    Status,
    StatusPatch,
    VolumePlacement,
)
from rce.model import Resources
from rce_container.events import (
    Adopted,
    Apply,
    ApplyPatch,
    Changed,
    Drop,
    Due,
    Event,
    Faulted,
    Instruction,
    Lost,
    Made,
    Patch,
    Put,
    Quit,
    Removed,
    Reported,
    Start,
    StatusWanted,
    Stop,
    Sync,
    Tell,
    Wait,
)
from rce_container.life import ALIVE, LifeEvent, Phase
from rce_container.record import Container

BACKOFF = Backoff(first=0.5, longest=30.0)
"""Delays before a container that ended is recreated; the first time in a row it is recreated at once.
"""
STABLE_S = 30.0
"""A container that ran for this long starts at the first delay again."""


class ManagerCore:
    """All containers of one manager.

    Invariants: a container has an incarnation id exactly while it may have processes or folders; a container
    that is gone is forgotten.
    """

    def __init__(self) -> None:
        self.containers: dict[str, Container] = {}
        self._quitting = False
        self._out: list[Instruction] = []
        self._now = 0.0

    def handle(self, event: Event, now: float) -> list[Instruction]:
        """Handle an event; return the resulting instructions.

        Args:
            event: What happened.
            now: Seconds on a monotonic clock.
        """
        self._now = now
        self._out = []
        match event:
            case Put() | Patch() | Drop() | Sync() | StatusWanted():
                self._handle_desired(event)
            case Adopted():
                self._adopt(event)
            case Due(id=id_, ticket=ticket):
                self._due(id_, ticket)
            case Quit():
                self._quit()
            case Lost(id=id_, incarnation_id="", reason=reason):
                self._not_started(id_, reason)
            case Made() | Reported() | Changed() | Faulted() | Lost() | Removed():
                self._life(event)
            case _:
                assert_never(event)
        return self._out

    @property
    def statuses(self) -> tuple[EndpointStatus, ...]:
        """Return the status of all containers, for the master."""
        return tuple(container.status for container in self.containers.values())

    def resources(self, id_: str) -> Resources:
        """Return the resources that a desired container requests."""
        desired = self.containers[id_].desired
        return desired.contents.resources if desired is not None else Resources()

    def placements(self, id_: str) -> tuple[VolumePlacement, ...]:
        """Return which files the volumes of a desired container are to have."""
        desired = self.containers[id_].desired
        return desired.contents.volumes if desired is not None else ()

    def validate(self) -> None:
        """Check the invariants; for tests."""
        for id_, container in self.containers.items():
            assert container.id == id_
            assert container.phase is not Phase.GONE, f"{id_} is gone and not forgotten"
            if container.phase is Phase.WAITING:
                assert not container.incarnation_id, f"{id_} waits although something of it is there"
            if container.phase in {*ALIVE, Phase.CLEANING}:
                assert container.incarnation_id, f"{id_} is {container.phase.value} without an incarnation"

    # Desired state from the master

    def _handle_desired(self, event: Put | Patch | Drop | Sync | StatusWanted) -> None:
        match event:
            case Put(spec=spec):
                self._put(spec)
            case Patch(patch=patch):
                self._patch(patch)
            case Drop(id=id_, revision=revision, reason=reason, elsewhere=elsewhere):
                self._drop(id_, revision, reason, elsewhere=elsewhere)
            case Sync(specs=specs):
                self._sync(specs)
            case StatusWanted(id=id_):
                if (container := self.containers.get(id_)) is not None:
                    self._tell(container)
            case _:
                assert_never(event)

    def _put(self, spec: EndpointSpec) -> None:
        if self._quitting:
            return
        container = self.containers.get(spec.id)
        if container is None:
            container = self.containers[spec.id] = Container.make(spec.id, Phase.GONE)
        elif container.desired is not None and spec.revision < container.desired.revision:
            return
        container.desired = DesiredState(spec)
        was = container.phase
        container.course.advance(LifeEvent.DESIRE)
        if was is Phase.GONE:
            self._start(container)
        elif container.phase in {*ALIVE, Phase.STARTING} and container.incarnation_id:
            self._out.append(Apply(spec.id, container.incarnation_id, spec))

    def _patch(self, patch: SpecPatch) -> None:
        if self._quitting:
            return
        container = self.containers.get(patch.id)
        desired = None if container is None else container.desired
        if container is None or desired is None or (fit := desired.fit(patch)) is Fit.GAP:
            self._out.append(Tell(SpecWanted(id=patch.id)))
        elif fit is Fit.NEXT:
            desired.patch(patch)
            if container.phase in {*ALIVE, Phase.STARTING} and container.incarnation_id:
                self._out.append(ApplyPatch(patch.id, container.incarnation_id, patch))

    def _drop(self, id_: str, revision: int, reason: str, *, elsewhere: bool = False) -> None:
        container = self.containers.get(id_)
        if container is None:
            self._out.append(Tell(Gone(id=id_, revision=revision)))
            return
        container.desired = None
        container.drop_revision = revision
        self._release(container, reason, saves_states=elsewhere)

    def _sync(self, specs: Iterable[EndpointSpec]) -> None:
        desired = {spec.id: spec for spec in specs}
        for id_, container in list(self.containers.items()):
            if id_ not in desired:
                self._drop(id_, container.known_revision, "it is not desired here any more")
        for spec in desired.values():
            self._put(spec)

    def _quit(self) -> None:
        self._quitting = True
        for container in list(self.containers.values()):
            container.desired = None
            self._release(container, "its manager was told to end")

    def _release(self, container: Container, reason: str, *, saves_states: bool = False) -> None:
        was = container.phase
        container.course.advance(LifeEvent.RELEASE)
        if container.phase is Phase.GONE:
            self._forget(container)
        elif was in {*ALIVE, Phase.STARTING}:
            if container.incarnation_id:
                self._out.append(Stop(container.id, container.incarnation_id, reason, saves_states))
            self._tell(container)

    # Events of containers

    def _adopt(self, event: Adopted) -> None:
        id_ = event.status.id
        assert id_ not in self.containers, "containers are adopted before anything else happens"
        is_ill = event.status.state is EndpointState.DEGRADED
        phase = Phase.DEGRADED if is_ill else Phase.RUNNING
        container = self.containers[id_] = Container.make(
            id_, phase, incarnation_id=event.incarnation_id, address=event.address
        )
        container.reported = ObservedStatus(event.status)
        container.running_since = self._now

    def _life(self, event: Made | Reported | Changed | Faulted | Lost | Removed) -> None:
        container = self.containers.get(event.id)
        if container is None:
            return
        if isinstance(event, Made):
            self._made(container, event)
            return
        if event.incarnation_id != container.incarnation_id:
            return
        match event:
            case Reported(status=status):
                self._report(container, status)
            case Changed(patch=patch):
                self._change(container, patch)
            case Faulted(text=text):
                self._fault(container, text)
            case Lost(reason=reason):
                self._lost(container, reason)
            case Removed():
                self._removed(container)
            case _:
                assert_never(event)

    def _made(self, container: Container, event: Made) -> None:
        container.incarnation_id = event.incarnation_id
        container.address = event.address
        if container.phase is not Phase.STARTING or container.desired is None:
            self._out.append(Stop(container.id, event.incarnation_id, "it is not desired any more"))
            return
        self._out.append(Apply(container.id, event.incarnation_id, container.desired.whole))
        self._tell(container)

    def _report(self, container: Container, status: EndpointStatus) -> None:
        was = container.phase
        is_ill = status.state is EndpointState.DEGRADED
        container.course.advance(LifeEvent.ILLNESS if is_ill else LifeEvent.REPORT)
        container.reported = ObservedStatus(status)
        if was is Phase.STARTING:
            container.running_since = self._now
            container.detail = ""
        if container.phase in {*ALIVE, Phase.STOPPING}:
            self._tell(container)

    def _change(self, container: Container, patch: StatusPatch) -> None:
        """Apply a patch to an environment's report; a whole report came before it."""
        if container.reported is None:
            return
        container.reported.patch(patch)
        is_ill = patch.status.state is EndpointState.DEGRADED
        container.course.advance(LifeEvent.ILLNESS if is_ill else LifeEvent.REPORT)
        if container.phase in {*ALIVE, Phase.STOPPING}:
            container.number += 1
            told = msgspec.structs.replace(patch, status=container.describe(patch.status))
            self._out.append(Tell(PatchStatus(patch=told)))

    def _lost(self, container: Container, reason: str) -> None:
        was = container.phase
        if was is Phase.CLEANING:
            return
        container.course.advance(LifeEvent.LOSS)
        if container.phase is not Phase.CLEANING:
            return
        if container.running_since is not None and self._now - container.running_since >= STABLE_S:
            container.failures = 0
        container.running_since = None
        self._failed(container, f"ended unexpectedly ({reason})")

    def _removed(self, container: Container) -> None:
        if container.phase not in (Phase.STOPPING, Phase.CLEANING):
            self._lost(container, "its processes ended")
        container.course.advance(LifeEvent.REMOVED)
        container.incarnation_id = ""
        container.address = LinkAddress()
        container.reported = None
        if container.phase is Phase.GONE:
            self._restart_or_forget(container)
        elif container.desired is None:  # adopted, and the master has not mentioned it yet
            del self.containers[container.id]
        else:
            self._pause(container)

    def _not_started(self, id_: str, reason: str) -> None:
        container = self.containers.get(id_)
        if container is None:
            return
        if container.course.advance(LifeEvent.NOT_STARTED) is Phase.GONE:
            self._restart_or_forget(container)
            return
        self._failed(container, f"cannot be started: {reason}")
        self._pause(container)

    def _due(self, id_: str, ticket: int) -> None:
        container = self.containers.get(id_)
        if container is None or container.phase is not Phase.WAITING or container.ticket != ticket:
            return
        container.course.advance(LifeEvent.DUE)
        self._start(container)

    # Instructions

    def _start(self, container: Container) -> None:
        self._out.append(Start(container.id))

    def _pause(self, container: Container) -> None:
        delay = BACKOFF.pause_after(container.failures - 1)
        container.ticket += 1
        self._out.append(Wait(container.id, container.ticket, delay))
        self._tell(container)

    def _restart_or_forget(self, container: Container) -> None:
        if container.desired is None or self._quitting:
            self._forget(container)
            return
        container.course.advance(LifeEvent.DESIRE)
        container.detail = ""
        self._start(container)

    def _forget(self, container: Container) -> None:
        del self.containers[container.id]
        if not self._quitting:
            self._out.append(Tell(Gone(id=container.id, revision=container.drop_revision)))

    def _failed(self, container: Container, what: str) -> None:
        container.failures += 1
        container.detail = what
        if what != container.told or container.failures == 1:
            container.told = what
            self._fault(container, f"{what}; it is made again")
        self._tell(container)

    def _fault(self, container: Container, text: str) -> None:
        tag = container.id.partition("/")[2]
        self._out.append(Tell(Fault(id=container.id, text=f"container {tag}: {text}")))

    def _tell(self, container: Container) -> None:
        container.number += 1
        self._out.append(Tell(Status(status=container.status)))
