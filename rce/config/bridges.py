"""The short form of a robot's wiring: ``bridges``, which expand to interfaces and connections.

::

    bridges:
      - {topic: /amcl_pose, type: geometry_msgs/PoseStamped, from: robot, to: [cTag_01:/Robot1/amcl_pose]}
      - {service: /plan, type: nav_msgs/GetPlan, server: cTag_01, clients: robot}
      - {action: move_base, type: move_base_msgs/MoveBase, server: robot, clients: cTag_01:/Robot1/move_base}

An end is ``robot`` or a container's tag, with ``:/NAME`` where its name differs from the bridge's. Pure.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, assert_never, get_args

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from rce.config.exceptions import Fault
from rce.config.items import MessageTypeName, RosName
from rce.config.validation import Strict
from rce.model import (
    MAX_NAME_LENGTH,
    AddInterface,
    Connection,
    Form,
    InterfaceSpec,
    InterfaceType,
    Role,
    is_name,
)
from rce.model.written import ROS_NAME_PATTERN

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from typing import Self

ROBOT = "robot"
"""The robot's end in a bridge, whatever its ``robotID``."""

Kind = Literal["topic", "service", "action"]

_KEYS: dict[str, tuple[str, str]] = {
    "topic": ("from", "to"),
    "service": ("server", "clients"),
    "action": ("server", "clients"),
}
_WORDS = {
    Role.SUBSCRIBER: "sender",
    Role.PUBLISHER: "receiver",
    Role.SERVICE_CLIENT: "server",
    Role.SERVICE_PROVIDER: "client",
}
_ROS_NAME = re.compile(ROS_NAME_PATTERN)
_ACTION_SUFFIX = "Action"
_GOAL_SUFFIX = "ActionGoal"


class Part(NamedTuple):
    """A topic or service that a bridge carries; an action has five."""

    name: str
    """Below the bridge's name; empty for the bridge itself."""
    message_type: str
    source: Role
    """The role of the interfaces at the bridge's first end; the others have its complement."""
    forward: bool = True
    """Whether the first end is the one that ``from`` or ``server`` names."""


class End(NamedTuple):
    """An end of a bridge."""

    endpoint: str
    """A container's tag, or :data:`ROBOT`."""
    name: str = ""
    """Its topic, service or action there; empty: the bridge's."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``ENDPOINT`` or ``ENDPOINT:/NAME``.

        Raises:
            ValueError: It has another form.
        """
        endpoint, colon, name = text.partition(":")
        if not is_name(endpoint) or (colon and _ROS_NAME.fullmatch(name) is None):
            raise ValueError(
                f"must be 'robot' or a container's cTag, with ':/NAME' where its name differs; it is {text!r}"
            )
        return cls(endpoint, name)


def _check_end(text: str) -> str:
    End.parse(text)
    return text


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


EndText = Annotated[str, AfterValidator(_check_end)]
EndTexts = Annotated[tuple[EndText, ...], BeforeValidator(_as_list), Field(strict=False, min_length=1)]


class Bridge(Strict):
    """A topic, service or action that is carried from one end to others."""

    topic: RosName | None = None
    service: RosName | None = None
    action: RosName | None = None
    type: MessageTypeName | None = None
    """Of the messages, the service or the action; None: as the robot's graph has it."""
    source: EndText | None = Field(default=None, alias="from")
    """The end that a topic's messages come from."""
    to: EndTexts | None = None
    """The ends that they go to."""
    server: EndText | None = None
    """The end with the server of a service or an action."""
    clients: EndTexts | None = None
    """The ends with its clients."""
    form: Literal["forwarder", "converter"] = "forwarder"
    """The form of messages at the robot's end: serialized, or JSON."""

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        kinds = [kind for kind in get_args(Kind) if getattr(self, kind) is not None]
        if len(kinds) != 1:
            raise ValueError("must have one of the keys topic, service and action")
        needed = _KEYS[kinds[0]]
        values = {"from": self.source, "to": self.to, "server": self.server, "clients": self.clients}
        for key, value in values.items():
            if (value is not None) != (key in needed):
                verb = "must have the key" if key in needed else "must not have the key"
                raise ValueError(f"a bridge of a {kinds[0]} {verb} {key!r}")
        first, *others = self.ends
        for number, other in enumerate(others):
            if self._place(other) == self._place(first) or other in others[:number]:
                raise ValueError(f"joins {other.endpoint}:{other.name or self.name} twice")
        return self

    @property
    def kind(self) -> Kind:
        """The kind of the bridge: topic, service or action."""
        return "topic" if self.topic is not None else "service" if self.service is not None else "action"

    @property
    def name(self) -> str:
        """The topic's, service's or action's name, at ends that give no other."""
        return self.topic or self.service or self.action or ""

    @property
    def ends(self) -> tuple[End, ...]:
        """The sending or serving end, and after it the others."""
        first, others = (self.source, self.to) if self.kind == "topic" else (self.server, self.clients)
        return tuple(map(End.parse, (first or "", *(others or ()))))

    @property
    def robot_name(self) -> str | None:
        """Its name in the robot's graph; None if no end is the robot's."""
        return next((end.name or self.name for end in self.ends if end.endpoint == ROBOT), None)

    def parts(self, type_: str) -> Iterator[Part]:
        """Return the topics and services of the bridge.

        Args:
            type_: The type of the messages, the service or the action.
        """
        match self.kind:
            case "topic":
                yield Part("", type_, Role.SUBSCRIBER)
            case "service":
                yield Part("", type_, Role.SERVICE_CLIENT)
            case "action":
                action = type_.removesuffix(_ACTION_SUFFIX)
                yield Part("goal", f"{action}ActionGoal", Role.SUBSCRIBER, forward=False)
                yield Part("cancel", "actionlib_msgs/GoalID", Role.SUBSCRIBER, forward=False)
                yield Part("status", "actionlib_msgs/GoalStatusArray", Role.SUBSCRIBER)
                yield Part("feedback", f"{action}ActionFeedback", Role.SUBSCRIBER)
                yield Part("result", f"{action}ActionResult", Role.SUBSCRIBER)
            case _:
                assert_never(self.kind)

    def _place(self, end: End) -> tuple[str, str]:
        return end.endpoint, (end.name or self.name).lstrip("/")

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


def action_of(goal_type: str) -> str | None:
    """Return the type of the action whose goals have this type; None if it is not one of a goal."""
    return goal_type.removesuffix(_GOAL_SUFFIX) if goal_type.endswith(_GOAL_SUFFIX) else None


@dataclass
class Wiring:
    """Interfaces and connections: those that a file lists, and those that its bridges add.

    Args:
        robot: The robot's ID.
        interfaces: The file's own.
        connections: The file's own.
    """

    robot: str
    interfaces: list[AddInterface]
    connections: list[Connection]
    origins: dict[tuple[str, int], str] = field(default_factory=dict)
    """Key and index of each made item, and the bridge that it was made for, as a place in the file."""
    faults: list[Fault] = field(default_factory=list)

    def add(self, index: int, bridge: Bridge, type_: str) -> None:
        """Make the interfaces and connections that a bridge needs and that do not exist yet.

        Args:
            index: Of the bridge in the file.
            bridge: The bridge.
            type_: Its type.
        """
        place = f"bridges[{index}]"
        for part in bridge.parts(type_):
            first, *others = bridge.ends
            for other in others:
                source, target = (first, other) if part.forward else (other, first)
                self._join(place, bridge, part, source, target)

    def _join(self, place: str, bridge: Bridge, part: Part, source: End, target: End) -> None:
        a = self._interface(place, bridge, part, source, part.source)
        b = self._interface(place, bridge, part, target, part.source.complement)
        pair = {a.path, b.path}
        if not any({one.tag_a, one.tag_b} == pair for one in self.connections):
            self.origins["connections", len(self.connections)] = place
            self.connections.append(Connection(tag_a=a.path, tag_b=b.path))

    def _interface(self, place: str, bridge: Bridge, part: Part, end: End, role: Role) -> AddInterface:
        """Find or make the interface at one end."""
        on_robot = end.endpoint == ROBOT
        endpoint = self.robot if on_robot else end.endpoint
        addr = "/".join(filter(None, (end.name or bridge.name, part.name)))
        for index, one in enumerate(self.interfaces):
            spec = one.interface
            if one.endpoint == endpoint and spec.kind.role is role and _same(spec.addr, addr):
                if spec.message_type != part.message_type:
                    where = self.origins.get(("interfaces", index), f"interfaces[{index}]")
                    here, there = part.message_type, spec.message_type
                    problem = f"{endpoint}:{addr} carries {here} here and {there} in {where}"
                    self.faults.append(Fault(place, problem))
                return one
        form = Form.INTERFACE if not on_robot else Form(bridge.form.capitalize())
        made = AddInterface(
            endpoint=endpoint,
            interface=InterfaceSpec(
                tag=self._tag(endpoint, addr, role),
                type=str(InterfaceType(role, form)),
                message_type=part.message_type,
                addr=addr,
            ),
        )
        self.origins["interfaces", len(self.interfaces)] = place
        self.interfaces.append(made)
        return made

    def _tag(self, endpoint: str, addr: str, role: Role) -> str:
        """Name an interface: the same in every run, and readable.

        Those in containers have the robot's ID in front: other robots' files may carry the same topic there,
        and each robot removes its own interfaces when it leaves.
        """
        words = [addr.strip("~/").replace("/", "_"), _WORDS[role]]
        tag = "_".join(words if endpoint == self.robot else [self.robot, *words])
        taken = {one.interface.tag for one in self.interfaces if one.endpoint == endpoint}
        if len(tag) > MAX_NAME_LENGTH or tag in taken:
            digest = hashlib.sha256(addr.encode()).hexdigest()[:8]
            tag = f"{tag[: MAX_NAME_LENGTH - len(digest) - 1]}_{digest}"
        return tag


def _same(one: str, other: str) -> bool:
    return one.lstrip("/") == other.lstrip("/")


def expand(
    bridges: Sequence[Bridge],
    types: Mapping[int, str],
    robot: str,
    interfaces: Iterable[AddInterface],
    connections: Iterable[Connection],
) -> Wiring:
    """Make the long form of bridges.

    Args:
        bridges: The bridges of a file.
        types: Their types by index, for those that give none; one that is in neither place is left out.
        robot: The robot's ID.
        interfaces: Those that the file lists; one that fits is used again.
        connections: Those that the file lists.
    """
    wiring = Wiring(robot, list(interfaces), list(connections))
    for index, bridge in enumerate(bridges):
        type_ = bridge.type or types.get(index)
        if type_ is not None:
            wiring.add(index, bridge, type_)
    return wiring
