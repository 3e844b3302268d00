"""Events of a container's nodes, and the instructions that result from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rce.model import NodeSpec


@dataclass(frozen=True, slots=True)
class Desire:
    """Exactly these nodes are desired."""

    specs: tuple[NodeSpec, ...]


@dataclass(frozen=True, slots=True)
class Made:
    """The process that :class:`Launch` asked for runs."""

    tag: str
    life: int
    pid: int


@dataclass(frozen=True, slots=True)
class Refused:
    """The process that :class:`Launch` asked for could not be made."""

    tag: str
    life: int
    reason: str
    hopeless: bool
    """Whether a retry would not help: the package or executable does not exist."""


@dataclass(frozen=True, slots=True)
class Registered:
    """A life of a node registered with the ROS core."""

    tag: str
    life: int


@dataclass(frozen=True, slots=True)
class Lack:
    """Exactly these nodes cannot be launched yet, with the reason as text, by tag."""

    texts: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Beat:
    """A message came on a node's heartbeat topic."""

    tag: str


@dataclass(frozen=True, slots=True)
class Ended:
    """All processes of a life of a node are gone."""

    tag: str
    life: int
    code: int
    """As :attr:`subprocess.Popen.returncode`."""
    reason: str
    """How it ended, as text."""


@dataclass(frozen=True, slots=True)
class Restored:
    """A life of a node has the state that was kept for it, or will not get it."""

    tag: str
    life: int
    fault: str = ""
    """Why it was not restored; empty if it was, or there is none."""


@dataclass(frozen=True, slots=True)
class Unsaved:
    """What keeps the state of a node from being fetched or saved changed."""

    tag: str
    life: int
    text: str
    """Empty: nothing does any more."""


@dataclass(frozen=True, slots=True)
class Tick:
    """Time passed."""


Event = Desire | Lack | Made | Refused | Registered | Restored | Unsaved | Beat | Ended | Tick


@dataclass(frozen=True, slots=True)
class Launch:
    """Start a process; answered by :class:`Made` or :class:`Refused`, and in the end :class:`Ended`."""

    tag: str
    life: int
    spec: NodeSpec


@dataclass(frozen=True, slots=True)
class Halt:
    """End a life of a node by escalation; answered by :class:`Ended`."""

    tag: str
    life: int
    share: float
    """The share of the usual grace times that it gets: other nodes wait for it."""


@dataclass(frozen=True, slots=True)
class Tell:
    """Tell the user."""

    text: str


@dataclass(frozen=True, slots=True)
class Note:
    """Write a line to the node's log."""

    tag: str
    text: str


@dataclass(frozen=True, slots=True)
class Forget:
    """An undesired node has ended completely."""

    tag: str


Instruction = Launch | Halt | Tell | Note | Forget
