"""The software that robots run: Debian's ROS with programs in Python or C++, or our core and nodes."""

from __future__ import annotations

import importlib
import shutil
import sys
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.systems import roscpp_programs
from rce_fleet.experiments.workloads.graph import SOFTWARE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

WORKLOADS = "rce_fleet.experiments.workloads"
SYSTEM_PYTHON = "/usr/bin/python3"
"""The interpreter that Debian's rospy is installed for."""
PACKAGE = "experiment_workloads"
"""Name by which that interpreter imports the programs, without the rest of this distribution."""
PORT = 11311


class Software(ABC):
    """A ROS core, and the programs of the experiments on a library for nodes."""

    name: ClassVar[str]
    """As in the results."""
    title: ClassVar[str]
    """For people."""
    core_ready: ClassVar[str]
    """What its core prints when it is ready."""

    def missing(self) -> str:
        """Return what is missing on this machine; empty: nothing."""
        return ""

    def lacking(self, programs: Iterable[str]) -> list[str]:
        """Return those of some programs of the experiments that it does not have."""
        del programs
        return []

    def prepare(self, say: Callable[[str], None]) -> None:
        """Make what its programs need on this machine, once; it may take a minute.

        Args:
            say: Called with a line if something is made.

        Raises:
            ExperimentError: It cannot be made.
        """
        del say

    @abstractmethod
    def core(self, address: str) -> tuple[str, ...]:
        """Return the command line of a ROS core on port 11311."""

    @abstractmethod
    def workload(self, name: str) -> tuple[str, ...]:
        """Return the command line of a program of the experiments.

        Raises:
            ExperimentError: It does not have the program.
        """

    def environ(self, folder: Path) -> Mapping[str, str]:
        """Return the environment variables of such a program.

        Args:
            folder: Of the run; the programs can be imported from it afterwards.
        """
        del folder
        return {SOFTWARE: self.name}


class _DebianRos(Software):
    core_ready = "started core service"

    def missing(self) -> str:
        return "" if shutil.which("roscore") else "the program roscore (Debian: python3-roslaunch)"

    def core(self, address: str) -> tuple[str, ...]:
        del address
        return ("roscore", "-p", str(PORT))


class Ros(_DebianRos):
    """Debian's roscore and rospy."""

    name = "ros"
    title = "ROS 1 (roscore, rospy)"

    def workload(self, name: str) -> tuple[str, ...]:
        """Return the command line of a program for the system's interpreter."""
        return (SYSTEM_PYTHON, "-m", f"{PACKAGE}.{name}")

    def environ(self, folder: Path) -> Mapping[str, str]:
        """Return environment variables by which that interpreter finds the programs."""
        packages = folder / "python"
        packages.mkdir(exist_ok=True)
        link = packages / PACKAGE
        if not link.is_symlink():
            file = importlib.import_module(WORKLOADS).__file__
            assert file is not None
            link.symlink_to(Path(file).parent)
        return {SOFTWARE: self.name, "PYTHONPATH": str(packages), "PYTHONDONTWRITEBYTECODE": "1"}


class Roscpp(_DebianRos):
    """Debian's roscore and roscpp; its programs are compiled on the machine."""

    name = "roscpp"
    title = "ROS 1 (roscore, roscpp)"

    def missing(self) -> str:
        """Return what is missing: a core, a compiler, or headers."""
        return super().missing() or roscpp_programs.missing()

    def lacking(self, programs: Iterable[str]) -> list[str]:
        """Return the programs that have no form in C++."""
        return [program for program in programs if program not in roscpp_programs.PROGRAMS]

    def prepare(self, say: Callable[[str], None]) -> None:
        """Compile the programs, if their sources are new."""
        roscpp_programs.compiled_workloads(say)

    def workload(self, name: str) -> tuple[str, ...]:
        """Return the command line of a program; it is compiled if ``prepare`` was not called."""
        if self.lacking([name]):
            raise ExperimentError(f"the program {name} has no form in C++, for the software {self.name}")
        return (str(roscpp_programs.compiled_workloads()), name)


class Rce(Software):
    """Our core and nodes."""

    name = "rce"
    title = "our core and nodes"
    core_ready = "rce core ready"

    def core(self, address: str) -> tuple[str, ...]:
        """Return the command line of our core."""
        return ("rce", "core", "--bind", address, "--port", str(PORT))

    def workload(self, name: str) -> tuple[str, ...]:
        """Return the command line of a program for this interpreter."""
        return (sys.executable, "-m", f"{WORKLOADS}.{name}")


ROS, ROSCPP, RCE = Ros(), Roscpp(), Rce()
SOFTWARES: dict[str, Software] = {software.name: software for software in (ROS, ROSCPP, RCE)}
USUAL = (ROS.name, RCE.name)
"""What is compared if nothing else is asked for."""


def software_of(name: str) -> Software:
    """Return a software by its name.

    Raises:
        ExperimentError: There is none, or it is not installed.
    """
    found = SOFTWARES.get(name)
    if found is None:
        raise ExperimentError(f"there is no software {name}; there is {', '.join(SOFTWARES)}")
    if reason := found.missing():
        raise ExperimentError(f"the software {name} ({found.title}) needs {reason}")
    return found
