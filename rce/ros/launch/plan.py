"""What launch files ask for: nodes, parameters, and commands that come before them."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

from rce.ros import names

if TYPE_CHECKING:
    from rce.ros.launch.exceptions import Place


class Output(Enum):
    """Where a node's standard output goes."""

    SCREEN = "screen"
    LOG = "log"


class WorkingFolder(Enum):
    """In which folder a node starts."""

    ROS_HOME = "ROS_HOME"
    NODE = "node"
    """The folder of its program."""


@dataclass(frozen=True, slots=True)
class NodePlan:
    """A node to start."""

    name: str
    """Its global name."""
    package: str
    type: str
    """Its executable."""
    place: Place
    arguments: tuple[str, ...] = ()
    remappings: tuple[tuple[str, str], ...] = ()
    environ: tuple[tuple[str, str], ...] = ()
    """Variables to set; a later one replaces an earlier one of its name."""
    prefix: tuple[str, ...] = ()
    """Words before the command, such as ``nice`` or ``gdb --args``."""
    output: Output = Output.LOG
    folder: WorkingFolder = WorkingFolder.ROS_HOME
    respawn: bool = False
    """Start it again when it ends."""
    respawn_delay: float = 0.0
    """Seconds before it is started again."""
    required: bool = False
    """Its end ends the launch."""

    @property
    def namespace(self) -> str:
        """Its namespace: ``/`` or ``/a/b``."""
        return names.canonical(names.namespace_of(self.name))

    @property
    def ros_arguments(self) -> tuple[str, ...]:
        """The arguments that ROS defines: remappings and name."""
        base = names.segments(self.name)[-1]
        return (*(f"{source}:={target}" for source, target in self.remappings), f"__name:={base}")


class ParameterCommand(NamedTuple):
    """A command of ``<rosparam>`` that is carried out before parameters are set."""

    command: str
    """``delete`` or ``dump``."""
    name: str
    """A parameter or namespace."""
    file: str = ""
    """Where ``dump`` writes."""


class ArgumentPlan(NamedTuple):
    """An argument that a launch file declares at its top level."""

    name: str
    default: str | None
    """None if it must be given."""
    doc: str = ""


@dataclass(slots=True)
class LaunchPlan:
    """What launch files ask for."""

    nodes: list[NodePlan] = field(default_factory=list)
    parameters: dict[str, Any] = field(default_factory=dict)
    """Global name to value, in the order in which they were first set; namespaces are taken apart."""
    cleared: list[str] = field(default_factory=list)
    """Namespaces whose parameters are deleted before others are set."""
    commands: list[ParameterCommand] = field(default_factory=list)
    arguments: dict[str, ArgumentPlan] = field(default_factory=dict)
    files: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
