"""The events of a manager's containers, and the instructions that it decides on."""

from __future__ import annotations

from dataclasses import dataclass

from rce.control import EndpointSpec, EndpointStatus, LinkAddress, SpecPatch, StatusPatch, ToMaster


@dataclass(frozen=True, slots=True)
class Put:
    """The master desires a container with this specification."""

    spec: EndpointSpec


@dataclass(frozen=True, slots=True)
class Patch:
    """The master changed its specification of a container."""

    patch: SpecPatch


@dataclass(frozen=True, slots=True)
class Drop:
    """The master does not desire a container any more."""

    id: str
    revision: int
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Sync:
    """The master desires exactly these containers."""

    specs: tuple[EndpointSpec, ...]


@dataclass(frozen=True, slots=True)
class Adopted:
    """A container was found that an earlier manager had started; its environment has reported."""

    incarnation_id: str
    status: EndpointStatus
    address: LinkAddress


@dataclass(frozen=True, slots=True)
class Made:
    """The processes of a new incarnation were started."""

    id: str
    incarnation_id: str
    address: LinkAddress


@dataclass(frozen=True, slots=True)
class Reported:
    """An environment reported."""

    id: str
    incarnation_id: str
    status: EndpointStatus


@dataclass(frozen=True, slots=True)
class Changed:
    """An environment reported what changed since its last report."""

    id: str
    incarnation_id: str
    patch: StatusPatch


@dataclass(frozen=True, slots=True)
class StatusWanted:
    """The master misses a container's status."""

    id: str


@dataclass(frozen=True, slots=True)
class Faulted:
    """An environment reports a fault for the user."""

    id: str
    incarnation_id: str
    text: str


@dataclass(frozen=True, slots=True)
class Lost:
    """An environment is gone, or could not be started (``incarnation_id`` is empty then)."""

    id: str
    incarnation_id: str
    reason: str


@dataclass(frozen=True, slots=True)
class Removed:
    """An incarnation has been removed completely."""

    id: str
    incarnation_id: str


@dataclass(frozen=True, slots=True)
class Due:
    """The pause that :class:`Wait` asked for is over."""

    id: str
    ticket: int


@dataclass(frozen=True, slots=True)
class Quit:
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


@dataclass(frozen=True, slots=True)
class Start:
    """Start a new incarnation; answered by :class:`Made` or :class:`Lost`."""

    id: str


@dataclass(frozen=True, slots=True)
class Apply:
    """Give a specification to an environment."""

    id: str
    incarnation_id: str
    spec: EndpointSpec


@dataclass(frozen=True, slots=True)
class ApplyPatch:
    """Give an environment the changes of its specification."""

    id: str
    incarnation_id: str
    patch: SpecPatch


@dataclass(frozen=True, slots=True)
class Stop:
    """End an incarnation, nodes first; finally answered by :class:`Removed`."""

    id: str
    incarnation_id: str
    reason: str = ""
    """The reason, for the record of that incarnation."""


@dataclass(frozen=True, slots=True)
class Wait:
    """Answer by :class:`Due` after ``delay`` seconds."""

    id: str
    ticket: int
    delay: float


@dataclass(frozen=True, slots=True)
class Tell:
    """Send a message to the master."""

    message: ToMaster


Instruction = Start | Apply | ApplyPatch | Stop | Wait | Tell
