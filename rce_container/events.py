"""The events of a manager's containers, and the instructions that it decides on."""

from __future__ import annotations

from typing import assert_never

from msgspec import Struct

from rce.control import EndpointSpec, EndpointStatus, LinkAddress, SpecPatch, StatusPatch, ToMaster
from rce.control import messages as m


class Put(Struct, frozen=True):
    """The master desires a container with this specification."""

    spec: EndpointSpec


class Patch(Struct, frozen=True):
    """The master changed its specification of a container."""

    patch: SpecPatch


class Drop(Struct, frozen=True):
    """The master does not desire a container any more."""

    id: str
    revision: int
    reason: str = ""
    elsewhere: bool = False
    """Whether it continues at another machine."""


class Sync(Struct, frozen=True):
    """The master desires exactly these containers."""

    specs: tuple[EndpointSpec, ...]


class Adopted(Struct, frozen=True):
    """A container was found that an earlier manager had started; its environment has reported."""

    incarnation_id: str
    status: EndpointStatus
    address: LinkAddress


class Made(Struct, frozen=True):
    """The processes of a new incarnation were started."""

    id: str
    incarnation_id: str
    address: LinkAddress


class Reported(Struct, frozen=True):
    """An environment reported."""

    id: str
    incarnation_id: str
    status: EndpointStatus


class Changed(Struct, frozen=True):
    """An environment reported what changed since its last report."""

    id: str
    incarnation_id: str
    patch: StatusPatch


class StatusWanted(Struct, frozen=True):
    """The master misses a container's status."""

    id: str


class Faulted(Struct, frozen=True):
    """An environment reports a fault for the user."""

    id: str
    incarnation_id: str
    text: str


class Lost(Struct, frozen=True):
    """An environment is gone, or could not be started (``incarnation_id`` is empty then)."""

    id: str
    incarnation_id: str
    reason: str


class Removed(Struct, frozen=True):
    """An incarnation has been removed completely."""

    id: str
    incarnation_id: str


class Due(Struct, frozen=True):
    """The pause that :class:`Wait` asked for is over."""

    id: str
    ticket: int


class Quit(Struct, frozen=True):
    """The manager is to end, with all its containers."""


Event = (
    Put
    | Patch
    | Drop
    | Sync
    | StatusWanted
    | Adopted
    | Made
    | Reported
    | Changed
    | Faulted
    | Lost
    | Removed
    | Due
    | Quit
)


class Start(Struct, frozen=True):
    """Start a new incarnation; answered by :class:`Made` or :class:`Lost`."""

    id: str


class Apply(Struct, frozen=True):
    """Give a specification to an environment."""

    id: str
    incarnation_id: str
    spec: EndpointSpec


class ApplyPatch(Struct, frozen=True):
    """Give an environment the changes of its specification."""

    id: str
    incarnation_id: str
    patch: SpecPatch


class Stop(Struct, frozen=True):
    """End an incarnation, nodes first; finally answered by :class:`Removed`."""

    id: str
    incarnation_id: str
    reason: str = ""
    """The reason, for the record of that incarnation."""
    saves_states: bool = False
    """Whether the states of its nodes are saved first."""


class Wait(Struct, frozen=True):
    """Answer by :class:`Due` after ``delay`` seconds."""

    id: str
    ticket: int
    delay: float


class Tell(Struct, frozen=True):
    """Send a message to the master."""

    message: ToMaster


Instruction = Start | Apply | ApplyPatch | Stop | Wait | Tell


def event_of(message: m.Put | m.PatchSpec | m.StatusWanted | m.Drop | m.Sync) -> Event:
    """Return what a message of the master means for the containers."""
    match message:
        case m.Put(endpoint=spec):
            return Put(spec)
        case m.PatchSpec(patch=patch):
            return Patch(patch)
        case m.StatusWanted(id=id_):
            return StatusWanted(id_)
        case m.Drop(id=id_, revision=revision, reason=reason, elsewhere=elsewhere):
            return Drop(id_, revision, reason, elsewhere)
        case m.Sync(endpoints=specs):
            return Sync(specs)
        case _:
            assert_never(message)
