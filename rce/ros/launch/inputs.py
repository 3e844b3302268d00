"""What a launch file depends on besides its own text: files, packages, variables, commands."""

from __future__ import annotations

import os
import shlex
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from rce.ros.launch.exceptions import LaunchValueError
from rce.ros.names import segments
from rce.ros.node.settings import anonymous_name
from rce.ros.packages import PackageIndex

if TYPE_CHECKING:
    from collections.abc import Mapping


class LaunchInputs(Protocol):
    """The surroundings of launch files."""

    @property
    def environ(self) -> Mapping[str, str]:
        """Environment variables."""

    def read(self, file: str) -> bytes:
        """Return a file's contents.

        Raises:
            OSError: It cannot be read.
        """

    def find(self, package: str) -> Path:
        """Return a package's folder.

        Raises:
            LookupError: There is none of this name.
        """

    def is_file(self, path: str) -> bool:
        """Return whether a file is there."""

    def run(self, command: str) -> str:
        """Run a command; return what it prints.

        Raises:
            LaunchValueError: It cannot be run, or fails.
        """

    def anonymous_name(self, prefix: str) -> str:
        """Return a name that no other node has."""


class MachineInputs:
    """The surroundings of launch files on this machine.

    Args:
        packages: Where packages are; by default those of the environment and of the machine's ROS.
        environ: Environment variables.
    """

    def __init__(self, packages: PackageIndex | None = None, environ: Mapping[str, str] = os.environ) -> None:
        self.environ = environ
        self.packages = packages or PackageIndex.of_machine(environ)

    def read(self, file: str) -> bytes:
        """Return a file's contents."""
        return Path(file).read_bytes()

    def find(self, package: str) -> Path:
        """Return a package's folder."""
        return self.packages.find(package).path

    def is_file(self, path: str) -> bool:
        """Return whether a file is there."""
        return os.path.isfile(path)  # noqa: PTH113 - pathlib's method may raise

    def run(self, command: str) -> str:
        """Run a command without a shell; return what it prints."""
        words = shlex.split(command)
        if not words:
            raise LaunchValueError("command is empty")
        try:
            done = subprocess.run(words, stdout=subprocess.PIPE, env=dict(self.environ), check=False)  # noqa: S603
        except OSError as error:
            raise LaunchValueError(f"command {command!r} cannot be run: {error.strerror}") from error
        if done.returncode:
            raise LaunchValueError(f"command {command!r} ended with exit code {done.returncode}")
        return done.stdout.decode(errors="replace")

    def anonymous_name(self, prefix: str) -> str:
        """Return a name that no other node has."""
        return anonymous_name(prefix)


def find_launch_file(package: Path, name: str) -> Path:
    """Return a launch file of a package, at any depth.

    Args:
        package: The package's folder.
        name: The file's name, with or without folders.

    Raises:
        LaunchValueError: There is none, or several.
    """
    parts = segments(name)
    direct = [folder / name for folder in (package / "launch", package)]
    found = [file for file in direct if file.is_file()][:1] or sorted(
        file
        for file in package.rglob(parts[-1])
        if file.parts[-len(parts) :] == tuple(parts) and file.is_file()
    )
    if len(found) == 1:
        return found[0]
    if not found:
        raise LaunchValueError(f"package {package.name} in {package} has no file {name}")
    listed = ", ".join(map(str, found))
    raise LaunchValueError(f"several files of this package are called {name}: {listed}; give a path")
