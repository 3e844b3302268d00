"""Graph names: validation, resolution and remapping arguments. Pure.

The rules are those of http://wiki.ros.org/Names and http://wiki.ros.org/Remapping%20Arguments:

- ``/global`` stands for itself, ``relative`` is in the node's namespace, ``~private`` below the node's name;
- ``FROM:=TO`` renames, after both sides have been resolved;
- ``__key:=value`` sets an attribute of the node itself; ``_param:=value`` sets a private parameter.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from rce.ros.errors import InvalidNameError

SEPARATOR = "/"
PRIVATE = "~"
REMAP = ":="

_GRAPH_NAME = re.compile(r"[~/A-Za-z][A-Za-z0-9_/]*")
_BASE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def is_graph_name(name: str) -> bool:
    """Return whether ``name`` is a legal global, relative or private name."""
    return _GRAPH_NAME.fullmatch(name) is not None and "//" not in name


def is_base_name(name: str) -> bool:
    """Return whether ``name`` is a legal name without any namespace, as nodes have it."""
    return _BASE_NAME.fullmatch(name) is not None


def is_global(name: str) -> bool:
    """Return whether ``name`` is global."""
    return name.startswith(SEPARATOR)


def is_private(name: str) -> bool:
    """Return whether ``name`` is private, below a node's name."""
    return name.startswith(PRIVATE)


def canonical(name: str) -> str:
    """Drop doubled and trailing slashes; ``/`` stays."""
    parts = segments(name)
    if is_global(name):
        return SEPARATOR + SEPARATOR.join(parts)
    return SEPARATOR.join(parts)


def segments(name: str) -> list[str]:
    """Split a name at its slashes, without empty parts."""
    return [part for part in name.split(SEPARATOR) if part]


def join(namespace: str, name: str) -> str:
    """Put ``name`` below ``namespace``; a global or private name stays as it is."""
    if is_global(name) or is_private(name):
        return name
    if not namespace or namespace.endswith(SEPARATOR):
        return namespace + name
    return namespace + SEPARATOR + name


def namespace_of(name: str) -> str:
    """Return the namespace of a global name, with a trailing slash: ``/a/`` for ``/a/b``."""
    head, _, _ = name.rstrip(SEPARATOR).rpartition(SEPARATOR)
    return head + SEPARATOR


def resolve(name: str, caller: str) -> str:
    """Make ``name`` global, as seen from the node ``caller`` (a global node name), without remappings."""
    if not name:
        return canonical(namespace_of(caller))
    if is_global(name):
        return canonical(name)
    if is_private(name):
        return canonical(caller + SEPARATOR + name[1:])
    return canonical(namespace_of(caller) + name)


@dataclass(frozen=True, slots=True)
class Arguments:
    """A parsed command line."""

    remappings: Mapping[str, str] = field(default_factory=dict)
    """``FROM:=TO``, as written."""
    specials: Mapping[str, str] = field(default_factory=dict)
    """``__name``, ``__ns``, ``__log``, ``__ip``, ``__hostname``, ``__master``."""
    parameters: Mapping[str, str] = field(default_factory=dict)
    """``_name:=value``: private parameters, the name without its underscore, the value as written."""
    rest: tuple[str, ...] = ()
    """Arguments that are not remappings: the program's own."""


def parse_arguments(argv: Iterable[str]) -> Arguments:
    """Parse a command line. An argument without a name before ``:=`` belongs to the program.

    A remapping or attribute without a value is left out, as rospy does; a parameter without one is empty.
    """
    remappings: dict[str, str] = {}
    specials: dict[str, str] = {}
    parameters: dict[str, str] = {}
    rest: list[str] = []
    for argument in argv:
        source, mark, target = argument.partition(REMAP)
        if not mark or not source:
            rest.append(argument)
        elif source.startswith("_") and not source.startswith("__"):
            parameters[source[1:]] = target
        elif not target:
            continue
        elif source.startswith("__"):
            specials[source] = target
        else:
            remappings[source] = target
    return Arguments(remappings, specials, parameters, tuple(rest))


class Resolver:
    """Turns the names that a node uses into global names.

    Attributes:
        namespace: The node's namespace, global, with a trailing slash.
        node_name: The node's global name.
    """

    def __init__(
        self, base_name: str, namespace: str = "/", remappings: Mapping[str, str] | None = None
    ) -> None:
        """Prepare the names of one node.

        Args:
            base_name: The node's name without namespace.
            namespace: The node's namespace; made global if it is not.
            remappings: ``{from: to}``, as given on a command line.

        Raises:
            InvalidNameError: One of the names is not legal.
        """
        if not is_base_name(base_name):
            raise InvalidNameError(
                f"{base_name!r} cannot name a node: letters, digits and _ only, a letter first"
            )
        if namespace and not is_graph_name(namespace):
            raise InvalidNameError(f"{namespace!r} is not a legal namespace")
        root = canonical(SEPARATOR + namespace)
        self.namespace = root if root == SEPARATOR else root + SEPARATOR
        self.node_name = self.namespace + base_name
        self._remappings = {
            self._globally(source): self._globally(target) for source, target in (remappings or {}).items()
        }

    def resolve(self, name: str) -> str:
        """Make ``name`` global and apply the remappings.

        Raises:
            InvalidNameError: ``name`` is not a legal graph name.
        """
        globally = self._globally(name)
        return self._remappings.get(globally, globally)

    def _globally(self, name: str) -> str:
        if not is_graph_name(name):
            raise InvalidNameError(f"{name!r} is not a legal graph name")
        return resolve(name, self.node_name)
