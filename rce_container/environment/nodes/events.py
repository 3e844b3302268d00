"""Events of a container's nodes, and the instructions that result from them."""

from __future__ import annotations

from collections.abc import Mapping

from msgspec import Struct

from rce.model import NodeSpec


class Desire(Struct, frozen=True):
    """Exactly these nodes are desired."""

    specs: tuple[NodeSpec, ...]


class Made(Struct, frozen=True):
    """The process that :class:`Launch` asked for runs."""

    tag: str
    life: int
    pid: int


class Refused(Struct, frozen=True):
    """The process that :class:`Launch` asked for could not be made."""

    tag: str
    life: int
    reason: str
    hopeless: bool
    """Whether a retry would not help: the package or executable does not exist."""


class Registered(Struct, frozen=True):
    """A life of a node registered with the ROS core."""

    tag: str
    life: int


class Lack(Struct, frozen=True):
    """Exactly these nodes cannot be launched yet, with the reason as text, by tag."""

    texts: Mapping[str, str]


class Beat(Struct, frozen=True):
    """A message came on a node's heartbeat topic."""

    tag: str


class Ended(Struct, frozen=True):
    """All processes of a life of a node are gone."""

    tag: str
    life: int
    code: int
    """As :attr:`subprocess.Popen.returncode`."""
    reason: str
    """How it ended, as text."""


class Restored(Struct, frozen=True):
    """A life of a node has the state that was kept for it, or will not get it."""

    tag: str
    life: int
    fault: str = ""
    """Why it was not restored; empty if it was, or there is none."""


class Unsaved(Struct, frozen=True):
    """What keeps the state of a node from being fetched or saved changed."""

    tag: str
    life: int
    text: str
    """Empty: nothing does any more."""


class Tick(Struct, frozen=True):
    """Time passed."""


Event = Desire | Lack | Made | Refused | Registered | Restored | Unsaved | Beat | Ended | Tick


class Launch(Struct, frozen=True):
    """Start a process; answered by :class:`Made` or :class:`Refused`, and in the end :class:`Ended`."""

    tag: str
    life: int
    spec: NodeSpec


class Halt(Struct, frozen=True):
    """End a life of a node by escalation; answered by :class:`Ended`."""

    tag: str
    life: int
    share: float
    """The share of the usual grace times that it gets: other nodes wait for it."""


class Tell(Struct, frozen=True):
    """Tell the user."""

    text: str


class Note(Struct, frozen=True):
    """Write a line to the node's log."""

    tag: str
    text: str


class Forget(Struct, frozen=True):
    """An undesired node has ended completely."""

    tag: str


Instruction = Launch | Halt | Tell | Note | Forget
