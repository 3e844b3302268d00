"""The software that robots run: Debian's ROS, or our core and nodes."""

from __future__ import annotations

import importlib
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.workloads.graph import SOFTWARE

if TYPE_CHECKING:
    from collections.abc import Mapping

WORKLOADS = "rce_fleet.experiments.workloads"
SYSTEM_PYTHON = "/usr/bin/python3"
"""The interpreter that Debian's rospy is installed for."""
PACKAGE = "experiment_workloads"
"""Name by which that interpreter imports the programs, without the rest of this distribution."""
PORT = 11311


@dataclass(frozen=True, slots=True)
class Software:
    """A ROS core, and the programs of the experiments on a library for nodes.

    Attributes:
        name: As in the results.
        title: For people.
        core_ready: What its core prints when it is ready.
        tool: A program that it needs; empty: none.
    """

    name: str
    title: str
    core_ready: str
    tool: str = ""

    def missing(self) -> str:
        """Return what is missing on this machine; empty: nothing."""
        return self.tool if self.tool and shutil.which(self.tool) is None else ""

    def core(self, address: str) -> tuple[str, ...]:
        """Return the command line of a ROS core on port 11311."""
        if self is ROS:
            return (self.tool, "-p", str(PORT))
        return ("rce", "core", "--bind", address, "--port", str(PORT))

    def workload(self, name: str) -> tuple[str, ...]:
        """Return the command line of a program of the experiments."""
        if self is ROS:
            return (SYSTEM_PYTHON, "-m", f"{PACKAGE}.{name}")
        return (sys.executable, "-m", f"{WORKLOADS}.{name}")

    def environ(self, folder: Path) -> Mapping[str, str]:
        """Return the environment variables of such a program.

        Args:
            folder: Of the run; the programs can be imported from it afterwards.
        """
        if self is not ROS:
            return {SOFTWARE: self.name}
        packages = folder / "python"
        packages.mkdir(exist_ok=True)
        link = packages / PACKAGE
        if not link.is_symlink():
            file = importlib.import_module(WORKLOADS).__file__
            assert file is not None
            link.symlink_to(Path(file).parent)
        return {SOFTWARE: self.name, "PYTHONPATH": str(packages), "PYTHONDONTWRITEBYTECODE": "1"}


ROS = Software("ros", "ROS 1 (roscore, rospy)", "started core service", "roscore")
RCE = Software("rce", "our core and nodes", "rce core ready")
SOFTWARES = {software.name: software for software in (ROS, RCE)}


def software_of(name: str) -> Software:
    """Return a software by its name.

    Raises:
        ExperimentError: There is none, or it is not installed.
    """
    found = SOFTWARES.get(name)
    if found is None:
        raise ExperimentError(f"there is no software {name}; there is {', '.join(SOFTWARES)}")
    if found.missing():
        raise ExperimentError(f"the software {name} ({found.title}) needs the program {found.missing()}")
    return found
