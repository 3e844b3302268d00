"""How a node of a launch plan is started: command line, environment variables, folder."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rce.ros.launch.plan import NodePlan, WorkingFolder
from rce.ros.system import system_environ

if TYPE_CHECKING:
    from rce.ros.packages import PackageIndex


class NodeCommand(NamedTuple):
    """How to start a node."""

    argv: list[str]
    env: dict[str, str]
    folder: Path
    choice: str = ""
    """For the log: which of several programs of its name was chosen; else empty."""
    module: str = ""
    """A Python module that a distribution adds as this node; else empty."""
    arguments: tuple[str, ...] = ()
    """The part of ``argv`` that follows the program."""


def node_command(
    node: NodePlan,
    packages: PackageIndex,
    environ: Mapping[str, str],
    master_uri: str,
    log: Path | None = None,
) -> NodeCommand:
    """Return how to start a node.

    Args:
        node: The node.
        packages: Where its package is looked for.
        environ: The launcher's own environment variables.
        master_uri: The graph's master.
        log: The file of its log records, which it opens itself.

    Raises:
        PackageError: Its package or its executable is not there.
    """
    program = packages.find(node.package).program(node.type)
    variables = {name: value for name, value in environ.items() if name != "ROS_NAMESPACE"}
    if program.package.python == "system":
        variables = system_environ(variables, program.package.path)
    variables["ROS_MASTER_URI"] = master_uri
    if node.namespace != "/":
        variables["ROS_NAMESPACE"] = node.namespace
    variables.update(node.environ)
    arguments = (*node.arguments, *node.ros_arguments, *([] if log is None else [f"__log:={log}"]))
    argv = [*node.prefix, *program.command, *arguments]
    module = program.target if ":" not in program.target else ""
    own = Path(program.command[-1]).parent
    if node.folder is WorkingFolder.NODE:
        folder = own if own.is_dir() else program.package.path
    else:
        folder = ros_home(environ)
    return NodeCommand(argv, variables, folder, program.choice, module, arguments)


def ros_home(environ: Mapping[str, str]) -> Path:
    """Return the folder in which nodes start: ``ROS_HOME``, or ``~/.ros``."""
    home = environ.get("ROS_HOME")
    return Path(home) if home else Path(environ.get("HOME") or os.path.expanduser("~"), ".ros")  # noqa: PTH111
