"""Reads ``<node>``."""

from __future__ import annotations

import shlex
from enum import Enum
from typing import TYPE_CHECKING, TypeVar

from rce.ros import names
from rce.ros.launch.exceptions import LaunchValueError
from rce.ros.launch.plan import LaunchPlan, NodePlan, Output, WorkingFolder

if TYPE_CHECKING:
    from rce.ros.launch.element_reader import ElementReader
    from rce.ros.launch.scope import Scope

NODE = (
    *("pkg", "type", "machine", "name", "args", "output", "respawn", "respawn_delay"),
    *("cwd", "ns", "clear_params", "launch-prefix", "required"),
)
E = TypeVar("E", bound=Enum)


def node_name(reader: ElementReader, plan: LaunchPlan) -> str:
    """Return the name in a ``<node>``, without its namespace.

    Raises:
        LaunchValueError: It is missing, or has a namespace.
    """
    name = reader.required("name")
    if names.SEPARATOR in name:
        raise LaunchValueError(f"name is {name!r}, must be without a namespace; use ns")
    if not names.is_base_name(name):
        plan.warnings.append(f"{reader.element.place}: {name!r} is not a legal name of a node")
    return name


def read_node(reader: ElementReader, name: str, scope: Scope, inner: Scope, machines: set[str]) -> NodePlan:
    """Return the plan of a ``<node>``.

    Args:
        reader: The element.
        name: The node's name.
        scope: With the namespace of the node.
        inner: With the node's own remappings and environment variables.
        machines: Names of this machine.

    Raises:
        LaunchValueError: An attribute cannot be used.
    """
    package, executable = reader.required("pkg"), reader.required("type")
    machine = reader.text("machine")
    if machine and machine not in machines:
        raise LaunchValueError(
            f"machine is {machine!r}: nodes start on this machine only; launch the file there"
        )
    respawn, required = reader.flag("respawn"), reader.flag("required")
    if respawn and required:
        raise LaunchValueError("has both respawn and required; give one of them")
    folder = reader.text("cwd")
    return NodePlan(
        name=names.canonical(scope.namespace + name),
        package=package,
        type=executable,
        place=reader.element.place,
        arguments=tuple(_words(reader, "args")),
        remappings=tuple(inner.remappings.items()),
        environ=tuple(inner.environ),
        prefix=tuple(_words(reader, "launch-prefix")),
        output=_choice(Output, reader.text("output"), Output.LOG, "output"),
        folder=_choice(
            WorkingFolder, "ROS_HOME" if folder == "ros_home" else folder, WorkingFolder.ROS_HOME, "cwd"
        ),
        respawn=respawn,
        respawn_delay=reader.seconds("respawn_delay"),
        required=required,
    )


def _words(reader: ElementReader, name: str) -> list[str]:
    text = reader.text(name) or ""
    try:
        return shlex.split(text)
    except ValueError as error:
        raise LaunchValueError(f"{name} is {text!r}: {str(error).lower()}") from error


def _choice(kind: type[E], text: str | None, default: E, name: str) -> E:
    if text is None:
        return default
    try:
        return kind(text)
    except ValueError:
        known = " or ".join(str(one.value) for one in kind)
        raise LaunchValueError(f"{name} is {text!r}, must be {known}") from None
