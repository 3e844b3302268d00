"""Reads launch files into a plan, element by element."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from rce.ros import names
from rce.ros.launch.element_reader import ElementReader
from rce.ros.launch.exceptions import LaunchFileError, LaunchValueError, Place, errors_at
from rce.ros.launch.nodes import NODE, node_name, read_node
from rce.ros.launch.parameters import read_param, read_rosparam, set_parameter
from rce.ros.launch.plan import ArgumentPlan, LaunchPlan
from rce.ros.launch.scope import Scope
from rce.ros.launch.tree import Element, parse_launch_file

if TYPE_CHECKING:
    from rce.ros.launch.inputs import LaunchInputs

MAX_DEPTH = 32
"""How deep files may include others."""

LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
"""Addresses of ``<machine>`` that mean this machine."""

IGNORED = {"master": "has no effect", "test": "is left out: rostest runs tests"}
"""Elements of launch files that do nothing here, and why."""

ARG = ("name", "value", "default", "doc")
GROUP = ("ns", "clear_params")
INCLUDE = ("file", "ns", "clear_params", "pass_all_args")
REMAP = ("from", "to")
ENV = ("name", "value")


def load_launch_files(
    files: Iterable[str | os.PathLike[str]],
    arguments: Mapping[str, str] | None = None,
    *,
    inputs: LaunchInputs,
    namespace: str = "/",
) -> LaunchPlan:
    """Read launch files.

    Args:
        files: Their paths; all go into one plan.
        arguments: Values of their arguments.
        inputs: Files, packages and variables that they depend on.
        namespace: In which their nodes are.

    Raises:
        LaunchFileError: One of them is wrong; the text names file, line, element and reason.

    Example:
        >>> plan = load_launch_files(["robot.launch"], {"robot": "Robot1"}, inputs=MachineInputs())
        >>> [node.name for node in plan.nodes]
        ['/Robot1/amcl', '/Robot1/move_base']
    """
    loader = _Loader(inputs)
    for path in files:
        file = os.fspath(path)
        root = Scope(inputs, file, arguments=dict(arguments or {})).child(namespace)
        loader.load(file, root, Place(file, 0))
    return loader.plan


class _Loader:
    def __init__(self, inputs: LaunchInputs) -> None:
        self.plan = LaunchPlan()
        self._inputs = inputs
        self._depth = 0
        self._machines = set[str]()
        """Names that ``<machine>`` gives to this machine."""
        self._nodes: dict[str, Place] = {}

    def load(self, file: str, scope: Scope, place: Place) -> None:
        """Read one file in a scope.

        Args:
            file: Its path.
            scope: The scope of its elements.
            place: The element that names it, for an error.
        """
        with errors_at(place):
            data = self._inputs.read(file)
        root = parse_launch_file(data, file)
        self.plan.files.append(file)
        if text := root.attributes.get("deprecated"):
            self.plan.warnings.append(f"{root.place}: deprecated: {text}")
        self._load_all(root.children, scope)

    def _load_all(self, elements: Iterable[Element], scope: Scope) -> None:
        for element in elements:
            reader = ElementReader(element, scope)
            with errors_at(element.place):
                if element.tag not in IGNORED and not reader.applies:
                    continue
                self._load_element(reader, scope)

    def _load_element(self, reader: ElementReader, scope: Scope) -> None:
        tag = reader.element.tag
        if tag in IGNORED:
            self._warn(reader.element, IGNORED[tag])
            return
        load = {
            "arg": self._load_argument,
            "env": self._load_variable,
            "group": self._load_group,
            "include": self._load_include,
            "machine": self._load_machine,
            "node": self._load_node,
            "param": self._load_parameter,
            "remap": self._load_remapping,
            "rosparam": self._load_rosparam,
        }.get(tag)
        if load is None:
            self._warn(reader.element, "is not an element of launch files")
        else:
            load(reader, scope)

    # Elements

    def _load_argument(self, reader: ElementReader, scope: Scope) -> None:
        reader.check_attributes(ARG, self.plan)
        name = reader.required("name")
        value, default, doc = (reader.text(key) for key in ("value", "default", "doc"))
        if value is not None and default is not None:
            raise LaunchValueError("has both value and default; give one of them")
        scope.declare(name, value, default)
        if not self._depth and value is None:
            self.plan.arguments.setdefault(name, ArgumentPlan(name, default, doc or ""))

    def _load_parameter(self, reader: ElementReader, scope: Scope) -> None:
        read_param(reader, scope, self.plan, in_node=False)

    def _load_rosparam(self, reader: ElementReader, scope: Scope) -> None:
        read_rosparam(reader, scope, self.plan)

    def _load_group(self, reader: ElementReader, scope: Scope) -> None:
        reader.check_attributes(GROUP, self.plan)
        self._load_all(reader.element.children, self._inner_scope(reader, scope))

    def _load_remapping(self, reader: ElementReader, scope: Scope) -> None:
        reader.check_attributes(REMAP, self.plan)
        scope.remap(reader.required("from"), reader.required("to"))

    def _load_variable(self, reader: ElementReader, scope: Scope) -> None:
        reader.check_attributes(ENV, self.plan)
        name, value = reader.required("name"), reader.text("value")
        if value is None:
            raise LaunchValueError("needs the attribute value")
        if "=" in name or "\0" in name + value:
            raise LaunchValueError(f"{name!r} cannot be the name of an environment variable")
        scope.environ.append((name, value))

    def _load_machine(self, reader: ElementReader, _scope: Scope) -> None:
        name, address = reader.required("name"), reader.required("address")
        if address not in LOCAL:
            raise LaunchValueError(
                f"machine {name} is {address}: nodes start on this machine only; launch a file there"
            )
        self._machines.add(name)

    def _load_node(self, reader: ElementReader, scope: Scope) -> None:
        element = reader.element
        reader.check_attributes(NODE, self.plan)
        name = node_name(reader, self.plan)
        outer = self._inner_scope(reader, scope, node=name)
        own = outer.child(name)
        own.private = {}
        inner = scope.child()
        for child in element.children:
            self._load_in_node(child, scope, own, inner)
        for key, value in (*scope.private.items(), *own.private.items()):
            set_parameter(self.plan, names.canonical(f"{own.namespace}/{key}"), value, element.place)
        plan = read_node(reader, name, outer, inner, self._machines)
        before = self._nodes.setdefault(plan.name, plan.place)
        if before is not plan.place:
            raise LaunchValueError(
                f"two nodes are called {plan.name}, the other one at {before.file}:{before.line};"
                " give one of them another name or ns"
            )
        self.plan.nodes.append(plan)

    def _load_in_node(self, child: Element, scope: Scope, own: Scope, inner: Scope) -> None:
        reader = ElementReader(child, scope if child.tag in ("remap", "env") else own)
        with errors_at(child.place):
            match child.tag.lower():
                case "param" if reader.applies:
                    read_param(reader, own, self.plan, in_node=True)
                case "rosparam" if reader.applies:
                    read_rosparam(reader, own, self.plan, own)
                case "remap" if reader.applies:
                    self._load_remapping(reader, inner)
                case "env" if reader.applies:
                    self._load_variable(reader, inner)
                case "param" | "rosparam" | "remap" | "env":
                    pass  # its condition does not hold
                case _:
                    self._warn(child, "is not an element of <node>")

    def _load_include(self, reader: ElementReader, scope: Scope) -> None:
        element = reader.element
        reader.check_attributes(INCLUDE, self.plan)
        file = reader.required("file")
        passes_all = reader.flag("pass_all_args")
        inner = self._inner_scope(reader, scope)
        inner.file, inner.declared = file, set()
        passed = Scope(self._inputs, file, arguments=dict(scope.arguments) if passes_all else {})
        passed.passes_all = passes_all
        for child in element.children:
            self._load_in_include(child, scope, inner, passed)
        inner.arguments, inner.passes_all = passed.arguments, passes_all
        if self._depth >= MAX_DEPTH:
            raise LaunchValueError(
                f"files include each other more than {MAX_DEPTH} deep, perhaps in a circle"
            )
        self._depth += 1
        try:
            self.load(file, inner, element.place)
            unused = [] if passes_all else [name for name in passed.arguments if name not in inner.declared]
            if unused:
                raise LaunchValueError(f"{file} does not declare the argument {', '.join(unused)}")
        except LaunchFileError as error:
            if error.place is element.place:
                raise
            raise LaunchFileError(error.place, error.reason, (*error.included_from, element.place)) from error
        finally:
            self._depth -= 1

    def _load_in_include(self, child: Element, scope: Scope, inner: Scope, passed: Scope) -> None:
        reader = ElementReader(child, scope)
        with errors_at(child.place):
            match child.tag.lower():
                case "env" if reader.applies:
                    self._load_variable(reader, inner)
                case "arg" if reader.applies:
                    reader.check_attributes(ARG, self.plan)
                    name, value, default = (
                        reader.required("name"),
                        reader.text("value"),
                        reader.text("default"),
                    )
                    if (value is None) == (default is None) and not (passed.passes_all and value is None):
                        raise LaunchValueError("needs one of value and default to pass an argument")
                    passed.declare(name, value, default)
                case "env" | "arg":
                    pass  # its condition does not hold
                case _:
                    self._warn(child, "is not an element of <include>")

    # Parts of elements

    def _inner_scope(self, reader: ElementReader, scope: Scope, node: str = "") -> Scope:
        """Return the scope in an element's namespace; note that its parameters are to be cleared."""
        namespace = reader.text("ns")
        inner = scope.child(namespace)
        if reader.flag("clear_params", empty_is_false=True):
            if not node and namespace is None:
                raise LaunchValueError("clear_params needs the attribute ns")
            self.plan.cleared.append(names.canonical(inner.namespace + node))
        return inner

    def _warn(self, element: Element, text: str) -> None:
        self.plan.warnings.append(f"{element.place} {text}")
