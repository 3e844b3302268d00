"""Reads ``<param>`` and ``<rosparam>``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.ros import names
from rce.ros.launch.exceptions import LaunchValueError
from rce.ros.launch.plan import LaunchPlan, ParameterCommand
from rce.ros.launch.values import check, convert, read_yaml

if TYPE_CHECKING:
    from rce.ros.launch.element_reader import ElementReader
    from rce.ros.launch.scope import Scope

PARAM = ("name", "value", "type", "textfile", "binfile", "command")
ROSPARAM = ("command", "ns", "file", "param", "subst_value")
SOURCES = ("value", "textfile", "binfile", "command")


def set_parameter(plan: LaunchPlan, name: str, value: Any, where: object) -> None:
    """Add a parameter to a plan; a namespace is taken apart.

    Args:
        plan: The plan.
        name: The parameter's global name.
        value: Its value.
        where: Its place, for a warning.

    Raises:
        LaunchValueError: The value cannot be one of a parameter.
    """
    if isinstance(value, dict):
        for key, entry in value.items():
            if not isinstance(key, str):
                raise LaunchValueError(f"parameter {name}: the key {key!r} must be text; write it in quotes")
            if names.is_private(key):
                raise LaunchValueError(f"parameter {name}: the key {key!r} must not be private")
            set_parameter(plan, names.join(name, key), entry, where)
        return
    name = names.canonical(name)
    check(name, value)
    parents = names.segments(name)[:-1]
    for count in range(len(parents) + 1):
        parent = "/" + "/".join(parents[:count])
        if parent in plan.parameters:
            plan.warnings.append(f"{where}: parameter {name} is below {parent}, which is a single value")
    plan.parameters[name] = value


def read_param(reader: ElementReader, scope: Scope, plan: LaunchPlan, *, in_node: bool) -> None:
    """Read a ``<param>``.

    Args:
        reader: The element.
        scope: Where private parameters go; its namespace is that of others.
        plan: Where others go.
        in_node: It stands in a ``<node>``, so it is private.
    """
    reader.check_attributes(PARAM, plan)
    given = [name for name in SOURCES if name in reader.element.attributes]
    if len(given) != 1:
        raise LaunchValueError(f"needs one of {', '.join(SOURCES)}, has {' and '.join(given) or 'none'}")
    name = reader.resolve(reader.element.attributes.get("name", "").strip())
    if not name:
        raise LaunchValueError("needs the attribute name")
    try:
        value = _param_value(reader, scope, given[0])
    except LaunchValueError as error:
        raise LaunchValueError(f"parameter {name}: {error}") from error
    check(name, value)
    if in_node or names.is_private(name):
        scope.set_private(name, value)
    else:
        set_parameter(plan, names.join(scope.namespace, name), value, reader.element.place)


def _param_value(reader: ElementReader, scope: Scope, source: str) -> Any:
    kind = reader.element.attributes.get("type") or "auto"
    text = reader.text(source) or ""
    match source:
        case "textfile":
            text = scope.inputs.read(text).decode()
        case "binfile":
            return scope.inputs.read(text)
        case "command":
            text = scope.inputs.run(text)
        case _:
            text = text.strip()
    try:
        return convert(text, kind)
    except LaunchValueError as error:
        raise LaunchValueError(f"{source} {error}") from error


def read_rosparam(reader: ElementReader, scope: Scope, plan: LaunchPlan, node: Scope | None = None) -> None:
    """Read a ``<rosparam>``.

    Args:
        reader: The element.
        scope: Its namespace is that of the parameters.
        plan: Where they go.
        node: Set in a ``<node>``: the scope whose namespace is the node's name, for ``~`` names.
    """
    reader.check_attributes(ROSPARAM, plan)
    command = reader.text("command") or "load"
    file = reader.text("file")
    relative = names.join(reader.text("ns") or "", reader.text("param") or "")
    if names.is_private(relative):
        if node is None:
            raise LaunchValueError(f"{relative!r} is private; it must stand in a <node>")
        relative = relative[1:]
    name = names.canonical(names.join(scope.namespace, relative))
    match command:
        case "load":
            _load(reader, scope, plan, name, file, is_named=bool(relative))
        case "delete":
            if file is not None:
                raise LaunchValueError("the command delete has no file")
            plan.commands.append(ParameterCommand(command, name))
        case "dump":
            if not file:
                raise LaunchValueError("the command dump needs the attribute file")
            plan.commands.append(ParameterCommand(command, name, file))
        case _:
            raise LaunchValueError(f"command is {command!r}, must be load, delete or dump")


def _load(
    reader: ElementReader, scope: Scope, plan: LaunchPlan, name: str, file: str | None, *, is_named: bool
) -> None:
    text = scope.inputs.read(file).decode() if file else reader.element.text
    if reader.flag("subst_value"):
        text = reader.resolve(text)
    try:
        value = read_yaml(text)
    except LaunchValueError as error:
        raise LaunchValueError(f"{file}: {error}" if file else str(error)) from error
    if value is None:
        value = {}
    if not isinstance(value, dict) and not is_named:
        raise LaunchValueError("needs the attribute param, because its value is not a namespace")
    set_parameter(plan, name, value, reader.element.place)
