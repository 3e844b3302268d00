"""What is known at a place of a launch file: namespace, arguments, remappings, private parameters. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rce.ros import names
from rce.ros.launch.exceptions import LaunchValueError

if TYPE_CHECKING:
    from rce.ros.launch.inputs import LaunchInputs


@dataclass(slots=True)
class Scope:
    """The surroundings of an element. A group, a node or an included file changes a copy of its own."""

    inputs: LaunchInputs
    file: str
    namespace: str = "/"
    """Global, with a trailing slash."""
    arguments: dict[str, str] = field(default_factory=dict)
    declared: set[str] = field(default_factory=set)
    """Names of the arguments that ``<arg>`` declared here."""
    anonymous: dict[str, str] = field(default_factory=dict)
    remappings: dict[str, str] = field(default_factory=dict)
    private: dict[str, Any] = field(default_factory=dict)
    """``~name`` parameters for the nodes that follow."""
    environ: list[tuple[str, str]] = field(default_factory=list)
    passes_all: bool = False
    """Arguments were passed by ``pass_all_args``, so a declaration may replace their values."""

    def child(self, namespace: str | None = None, file: str = "") -> Scope:
        """Return a copy for an inner part.

        Args:
            namespace: Relative to this one, or global; None for the same one.
            file: The file of the inner part, if it is another one.

        Raises:
            LaunchValueError: The namespace cannot be used.
        """
        inner = self.namespace
        if namespace is not None:
            if not namespace or names.is_private(namespace):
                raise LaunchValueError(f"ns is {namespace!r}, must be a relative or global name")
            inner = names.canonical(names.join(self.namespace, namespace)).rstrip("/") + "/"
        return Scope(
            self.inputs,
            file or self.file,
            inner,
            dict(self.arguments),
            set(self.declared),
            dict(self.anonymous),
            dict(self.remappings),
            dict(self.private),
            list(self.environ),
        )

    def declare(self, name: str, value: str | None, default: str | None) -> None:
        """Declare an argument.

        Raises:
            LaunchValueError: It was declared before, or its value was given and is fixed here.
        """
        if name in self.declared and not self.passes_all:
            raise LaunchValueError(f"argument {name} is declared twice")
        self.declared.add(name)
        if value is not None:
            if name in self.arguments and not self.passes_all:
                raise LaunchValueError(
                    f"argument {name} is fixed here and cannot be set; use default= instead of value="
                )
            self.arguments[name] = value
        elif default is not None:
            self.arguments.setdefault(name, default)

    def remap(self, source: str, target: str) -> None:
        """Add a remapping; it replaces an earlier one of its name.

        Raises:
            LaunchValueError: A name is not legal.
        """
        pair = names.canonical(source), names.canonical(target)
        for label, name in zip(("from", "to"), pair, strict=True):
            if not name or not (names.is_graph_name(name) or name == names.SEPARATOR):
                raise LaunchValueError(
                    f"{label} is {name!r}, must be a name of a topic, service or parameter"
                )
        self.remappings.pop(pair[0], None)
        self.remappings[pair[0]] = pair[1]

    def set_private(self, name: str, value: Any) -> None:
        """Set a parameter of the nodes that follow; it replaces an earlier one of its name."""
        key = names.canonical(name.removeprefix(names.PRIVATE))
        self.private.pop(key, None)
        self.private[key] = value
