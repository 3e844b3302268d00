"""The names of the protocol: tags, interface types, endpoint ids.

Wire source: the RoboEarth Cloud Engine's client protocol (``docs/protocol.md``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

T = TypeVar("T")

_Label = tuple[tuple[bool, int, str], ...]
VersionKey = tuple[bool, tuple[int, ...], bool, _Label, str]

NAME_PATTERN = r"[A-Za-z][A-Za-z0-9_]*"
"""Valid names of users, robots, containers, nodes, interfaces and parameter segments."""

MESSAGE_TYPE_PATTERN = rf"{NAME_PATTERN}/{NAME_PATTERN}"
"""Valid names of message and service types: ``package/Type``."""

VERSION_PATTERN = r"[0-9]{1,9}(\.[0-9]{1,9}){0,3}(-[0-9A-Za-z]+(\.[0-9A-Za-z]+)*)?"
"""Valid versions of packages: up to four numbers, and a label for pre-releases."""

MAX_NAME_LENGTH = 128
MAX_VERSION_LENGTH = 64

_NAME = re.compile(NAME_PATTERN)
_MESSAGE_TYPE = re.compile(MESSAGE_TYPE_PATTERN)
_VERSION = re.compile(VERSION_PATTERN)


def is_name(text: str) -> bool:
    """Return whether ``text`` may name a user, robot, container, node or interface."""
    return len(text) <= MAX_NAME_LENGTH and _NAME.fullmatch(text) is not None


def is_message_type(text: str) -> bool:
    """Return whether ``text`` may name a message or service type (``std_msgs/String``)."""
    return len(text) <= 2 * MAX_NAME_LENGTH and _MESSAGE_TYPE.fullmatch(text) is not None


def is_version(text: str) -> bool:
    """Return whether ``text`` may be the version of a package (``1.2.0``, ``2.0-rc1``)."""
    return len(text) <= MAX_VERSION_LENGTH and _VERSION.fullmatch(text) is not None


class Role(Enum):
    """The role of an interface, seen from the engine."""

    SERVICE_CLIENT = "ServiceClient"
    """The engine calls a service on this side: requests come from the peer, this side answers them."""
    SERVICE_PROVIDER = "ServiceProvider"
    """The engine offers a service on this side: this side asks, the peer answers. Takes one connection."""
    PUBLISHER = "Publisher"
    """The engine publishes the peers' messages on this side."""
    SUBSCRIBER = "Subscriber"
    """The engine takes messages on this side and sends them to the peers."""

    @property
    def is_service(self) -> bool:
        """Whether the interface carries a service, not a topic."""
        return self in (Role.SERVICE_CLIENT, Role.SERVICE_PROVIDER)

    @property
    def complement(self) -> Role:
        """The role that the other end of a connection must have."""
        return _COMPLEMENT[self]


_COMPLEMENT = {
    Role.SERVICE_CLIENT: Role.SERVICE_PROVIDER,
    Role.SERVICE_PROVIDER: Role.SERVICE_CLIENT,
    Role.PUBLISHER: Role.SUBSCRIBER,
    Role.SUBSCRIBER: Role.PUBLISHER,
}


class Form(Enum):
    """The end of an interface, and the form of its messages there."""

    INTERFACE = "Interface"
    """Container end: a ROS topic or service at ``addr``."""
    CONVERTER = "Converter"
    """Robot end: messages are JSON objects."""
    FORWARDER = "Forwarder"
    """Robot end: messages are serialized ROS messages, passed through untouched."""


@dataclass(frozen=True, slots=True)
class InterfaceType:
    """An interface type such as ``PublisherConverter``: a role and a form."""

    role: Role
    form: Form

    @classmethod
    def parse(cls, text: str) -> InterfaceType:
        """Read an interface type.

        Raises:
            ValueError: ``text`` names no interface type; the message lists the valid ones.
        """
        found = _TYPES.get(text)
        if found is None:
            raise ValueError(f"unknown interface type {text!r}; use one of {', '.join(_TYPES)}")
        return found

    def __str__(self) -> str:
        return self.role.value + self.form.value


_TYPES = {str(t): t for t in (InterfaceType(role, form) for role in Role for form in Form)}


@dataclass(frozen=True, slots=True, order=True)
class EndpointId:
    """A robot or container of a user, written ``user/tag``.

    Tags are unique among a user's robots and containers.
    """

    user: str
    tag: str

    @classmethod
    def parse(cls, text: str) -> EndpointId:
        """Read ``user/tag``.

        Raises:
            ValueError: ``text`` is not two names with a slash between them.
        """
        user, slash, tag = text.partition("/")
        if not slash or not is_name(user) or not is_name(tag):
            raise ValueError(f"{text!r} is not an endpoint id of the form user/tag")
        return cls(user, tag)

    def __str__(self) -> str:
        return f"{self.user}/{self.tag}"


def split_package(text: str) -> tuple[str, str]:
    """Split a node's package, ``NAME`` or ``NAME@VERSION``; without a version the second part is empty."""
    name, _, version = text.partition("@")
    return name, version


def version_key(version: str) -> VersionKey:
    """Make a sort key: numbers count as numbers, and versions with a label come before those without.

    Args:
        version: As :func:`rce.model.names.is_version` allows it.
    """
    numbers, dash, label = version.partition("-")
    parts = [int(part) for part in numbers.split(".")]
    while len(parts) > 1 and not parts[-1]:
        parts.pop()
    words = tuple(
        (not word.isdigit(), int(word) if word.isdigit() else 0, word) for word in label.split(".") if word
    )
    return not dash, tuple(parts), not dash, words, version


def newest(items: Iterable[T], version: Callable[[T], str]) -> T | None:
    """Return the newest version: the highest release; one with a label only if there are no releases."""
    return max(items, key=lambda item: version_key(version(item)), default=None)
