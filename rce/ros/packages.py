"""Packages: folders that hold nodes and message definitions.

A package is a folder with a ``package.yaml`` (ours) or a ``package.xml`` (ROS's), at any depth below a folder
of the package path (:mod:`rce.ros.package_tree`), or one directly below that holds ``msg`` or ``srv`` folders
only, as distributions install them. Its executables are files in the folder itself or in
``nodes``, ``scripts``, ``bin`` or ``lib`` below it; those of a package that is installed as
``PREFIX/share/PKG`` are also in ``PREFIX/lib/PKG``. Executables in none of these are searched at any depth of
the package's folder, as rosrun and roslaunch do (:mod:`rce.ros.executables`).

An installed Python distribution adds packages and nodes by entry points; the path takes precedence:

* group ``rce.packages``: named after a package; the value is the Python package whose folder it is.
* group ``rce.nodes``: named ``PKG:EXE``; the value is a function, or a module that is run as a script.

``package.yaml`` holds::

    name: Test                  # optional: the folder's name
    description: What it is for
    python: engine              # .py files run with the engine's Python; system: as their first line says
    version: '1.2.0'            # optional; of a package that is brought to an engine (``rce package push``)
"""

from __future__ import annotations

import logging
import os
import re
import reprlib
import sys
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

from rce.ros.entry_points import arguments_of, distributed_nodes, distributed_packages, folder_of, scripts_of
from rce.ros.errors import BadPackageError, ExecutableNotFoundError, PackageNotFoundError
from rce.ros.executables import ExecutableFinder, is_executable
from rce.ros.package_tree import PackageTree

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping


PATH_VARIABLES = ("RCE_PACKAGE_PATH", "ROS_PACKAGE_PATH")
"""Environment variables that hold package paths, the more important first."""

FOLDERS = ("", "nodes", "scripts", "bin", "lib")
"""Folders below a package in which a node's file is looked for."""

MANIFESTS = ("package.yaml", "package.xml")
"""Names of manifests, the more important first."""

ROSBUILD_MANIFEST = "manifest.xml"
"""The manifest of packages from before catkin, which gives no name: the folder's counts."""

_log = logging.getLogger(__name__)

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_PYTHONS = ("engine", "system")


class Package(NamedTuple):
    """A package that was found."""

    name: str
    path: Path
    description: str = ""
    python: str = "system"
    """``engine``: .py files run with the engine's Python; ``system``: as their first line says."""
    version: str = ""
    """As in the manifest; empty if it has none."""

    def executable(self, exe: str) -> list[str]:
        """Return the command that starts a node: the first words of its command line.

        Args:
            exe: Name of the file, with or without the folder below the package.

        Raises:
            ExecutableNotFoundError: The file does not exist, may not be executed, or the name leads out of
            the package.
        """
        return self.program(exe).command

    def program(self, exe: str) -> Program:
        """Return a node's program: a file of the package, else one that a Python distribution adds.

        Args:
            exe: As for :meth:`executable`.

        Raises:
            ExecutableNotFoundError: As for :meth:`executable`.
        """
        if not exe or exe.startswith("/") or "\0" in exe or ".." in PurePosixPath(exe).parts:
            raise ExecutableNotFoundError(f"{exe!r} is not a file inside package {self.name}")
        files = [folder / exe for folder in self._folders()]
        meant = [file for file in files if os.path.isfile(file)]  # noqa: PTH113 - pathlib's method may raise
        for file in meant:
            if command := self._command(file):
                return self._found(exe, command)
        if "/" not in exe and (found := _finder.find(self.path, exe)) is not None:
            return self._found(exe, [str(found)])
        if meant:
            raise ExecutableNotFoundError(f"{meant[0]} may not be executed (chmod +x makes it so)")
        if target := dict(scripts_of(self.name)).get(exe):  # last: it searches all installed distributions
            return self._distributed_program(exe, target)
        where = ", ".join(str(folder) for folder in self._folders() if folder.is_dir())
        raise ExecutableNotFoundError(
            f"package {self.name} has no executable {exe!r} (looked in {where or self.path}, and below"
            f" {self.path} for one that may be executed)"
        )

    def _found(self, exe: str, command: list[str]) -> Program:
        """Return the program of a file; a distribution may add one of the same name, which is not used."""
        rival = dict(scripts_of(self.name)).get(exe)
        choice = f"{self.name}/{exe} is {command[-1]}, not {rival}" if rival else ""
        return Program(command, self, choice)

    def _distributed_program(self, exe: str, target: str) -> Program:
        command = [sys.executable, *arguments_of(target)]
        if self.name in distributed_packages():
            return Program(command, self, target=target)
        folder = folder_of(target)
        why = "" if self.path == folder else f"; the package in {self.path} does not have it"
        package = Package(self.name, folder, python="engine")
        return Program(command, package, f"{self.name}/{exe} is {target}{why}", target)

    def _folders(self) -> Iterator[Path]:
        for folder in FOLDERS:
            yield self.path / folder
        if self.path.parent.name == "share":
            yield self.path.parent.parent / "lib" / self.name

    def _command(self, file: Path) -> list[str]:
        """Return the command that executes a file; empty if it may not be executed."""
        if self.python == "engine" and file.suffix == ".py":
            return [sys.executable, str(file)]
        return [str(file)] if is_executable(file) else []


class Program(NamedTuple):
    """A package's executable that was found."""

    command: list[str]
    """The first words of its command line."""
    package: Package
    """To which it belongs; a program of a Python distribution is not part of a ROS package of its name."""
    choice: str = ""
    """For the log: which one was chosen, if a distribution adds one of this name; else empty."""
    target: str = ""
    """``module[:function]`` of a Python distribution's program; else empty."""


class PackageIndex:
    """Finds packages by name, as rospack does. A package that is added later is found.

    Args:
        path: Folders that are searched in depth, or are packages themselves; the first hit counts. In one
            called ``share``, packages are direct subfolders, as distributions install them.
    """

    def __init__(self, path: Iterable[Path | str]) -> None:
        self.path = tuple(Path(folder) for folder in path)

    @classmethod
    def from_environ(cls, environ: Mapping[str, str] = os.environ) -> PackageIndex:
        """Make an index of the paths in ``RCE_PACKAGE_PATH`` and ``ROS_PACKAGE_PATH``."""
        texts = (environ.get(variable, "") for variable in PATH_VARIABLES)
        return cls(folder for text in texts for folder in text.split(os.pathsep) if folder)

    @classmethod
    def of_machine(cls, environ: Mapping[str, str] = os.environ) -> PackageIndex:
        """Make an index of the paths in the environment, and of this machine's ROS distributions."""
        return cls(dict.fromkeys([*cls.from_environ(environ).path, *installed_shares()]))

    def __repr__(self) -> str:
        return f"<PackageIndex {self.describe_path()}>"

    def find(self, name: str) -> Package:
        """Return the package of a name.

        Raises:
            PackageNotFoundError: It is not on the path, and no distribution adds nodes under its name.
            BadPackageError: Its manifest cannot be read.
        """
        folder = self.locate(name)
        if folder is not None:
            return _read_package(folder, name)
        scripts = scripts_of(name)
        if scripts:
            return Package(name, folder_of(scripts[0][1]), python="engine")
        closed = [str(root) for root in self.path if root.exists() and not os.access(root, os.R_OK | os.X_OK)]
        hint = f"; {os.pathsep.join(closed)} may not be read here" if closed else ""
        raise PackageNotFoundError(f"no package {name!r} on the package path ({self.describe_path()}){hint}")

    def locate(self, name: str) -> Path | None:
        """Return the folder of a package; None if it is neither on the path nor in a distribution.

        Raises:
            BadPackageError: A distribution names a folder that does not exist.
        """
        if _NAME.fullmatch(name) is None:
            return None
        for root in self.path:
            found = _find_below(root, name)
            if found is not None:
                return found
        target = distributed_packages().get(name)
        return None if target is None else folder_of(target)

    async def look_ahead(self) -> None:
        """Search in a thread where that may take long, so that look-ups after this do not hold the loop."""
        if any(_tree(root).is_slow for root in self._searched()):
            import asyncio

            await asyncio.to_thread(self.look)

    def look(self) -> None:
        """Search the folders, or check them for changes; an error is raised again by the look-up itself."""
        for root in self._searched():
            try:
                _tree(root).packages()
            except Exception:  # noqa: BLE001 - whatever a folder's content causes
                _log.debug("packages below %s cannot be searched", root, exc_info=True)

    def expire(self) -> None:
        """Have the next look-up check all folders: another user, or another process, has searched them."""
        for root in self._searched():
            _tree(root).expire()

    def _searched(self) -> Iterator[Path]:
        """Yield the folders that are searched in depth."""
        return (root for root in self.path if not _is_distribution(root))

    def describe_path(self) -> str:
        """Return the path as text for errors."""
        return os.pathsep.join(map(str, self.path)) or "empty"


def distributed_folders() -> list[Path]:
    """Return the folders of the Python packages that add packages or nodes by entry points."""
    targets = [*distributed_packages().values(), *(target for _, _, target in distributed_nodes())]
    names = sorted({target.partition(":")[0].partition(".")[0] for target in targets})
    specs = [spec for name in names if (spec := find_spec(name)) is not None]
    return [Path(folder) for spec in specs for folder in spec.submodule_search_locations or ()]


def installed_shares() -> list[Path]:
    """Return the folders in which this machine's ROS distributions keep their packages."""
    candidates = [*sorted(Path("/opt/ros").glob("*/share")), Path("/usr/share")]
    return [share for share in candidates if (share / "std_msgs").is_dir()]


def _find_below(root: Path, name: str) -> Path | None:
    """Return the folder of a package that is on or below one folder of the path."""
    if _is_distribution(root):
        return _installed(root, name)
    found = _tree(root).packages().get(name)
    if found is not None:
        return found
    child = root / name
    return child if _manifest(child) is None and _holds_definitions(child) else None


def _is_distribution(root: Path) -> bool:
    return root.name == "share" and (root.parent / "lib").is_dir()


def _installed(share: Path, name: str) -> Path | None:
    """Find a package of a distribution: ``PREFIX/share/NAME``, with programs in ``PREFIX/lib/NAME``."""
    folder = share / name
    if _manifest(folder) is not None:
        return folder if _declared_name(folder) in ("", name) else None
    if _holds_definitions(folder):
        return folder
    programs = share.parent / "lib" / name
    if programs.is_dir():
        return folder if folder.is_dir() else programs
    return share if _manifest(share) is not None and (_declared_name(share) or share.name) == name else None


def _holds_definitions(folder: Path) -> bool:
    # Not pathlib's method: it raises if a folder may not be entered, and the other folders must be searched.
    return any(os.path.isdir(folder / kind) for kind in ("msg", "srv", "action"))  # noqa: PTH112


_finder = ExecutableFinder()
_trees: dict[Path, PackageTree] = {}
MAX_TREES = 64
"""How many folders' searches are remembered."""


def _tree(root: Path) -> PackageTree:
    found = _trees.get(root)
    if found is None:
        while len(_trees) >= MAX_TREES:
            _trees.pop(next(iter(_trees)), None)
        found = _trees.setdefault(root, PackageTree(root, (*MANIFESTS, ROSBUILD_MANIFEST), _name_in))
    return found


def _name_in(folder: Path) -> str:
    return _declared_name(folder) or folder.resolve().name


def _manifest(folder: Path) -> Path | None:
    for name in (*MANIFESTS, ROSBUILD_MANIFEST):
        file = folder / name
        if os.path.isfile(file):  # noqa: PTH113 - see above
            return file
    return None


def _declared_name(folder: Path) -> str:
    """Return the name in a manifest; empty if it gives none or cannot be read."""
    try:
        return _read_package(folder, "").name
    except BadPackageError:
        return ""


def _read_package(folder: Path, name: str) -> Package:
    manifest = _manifest(folder)
    if manifest is None:
        return Package(name, folder)
    try:
        text = manifest.read_bytes()
    except OSError as error:
        raise BadPackageError(f"{manifest}: {error}") from error
    return parse_manifest(manifest, text, name)


def parse_manifest(manifest: Path, text: bytes, name: str) -> Package:
    """Read the text of a manifest.

    Args:
        manifest: Its path; the suffix tells its kind.
        text: Its contents.
        name: The package's name if the manifest gives none.

    Raises:
        BadPackageError: It cannot be read.
    """
    return (_parse_xml if manifest.suffix == ".xml" else _parse_yaml)(manifest, text, name)


def _parse_yaml(manifest: Path, text: bytes, name: str) -> Package:
    import yaml

    try:
        data = yaml.safe_load(text) or {}
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise BadPackageError(f"{manifest}: {error}") from error
    if not isinstance(data, dict):
        raise BadPackageError(f"{manifest}: must hold 'key: value' lines")
    python = data.get("python", "engine")
    if python not in _PYTHONS:
        raise BadPackageError(
            f"{manifest}: python is {reprlib.repr(python)}, must be one of {', '.join(_PYTHONS)}"
        )
    declared = data.get("name", name)
    if declared != "" and (not isinstance(declared, str) or _NAME.fullmatch(declared) is None):
        raise BadPackageError(f"{manifest}: {reprlib.repr(declared)} is not a package name")
    return Package(declared, manifest.parent, _text(data, "description"), python, _text(data, "version"))


def _text(data: dict[Any, Any], key: str) -> str:
    # Other values are not converted to text: a few lines of aliases may expand to a tree of any size.
    found = data.get(key, "")
    return found if isinstance(found, str) else ""


def _parse_xml(manifest: Path, text: bytes, name: str) -> Package:
    from xml.etree import ElementTree as ET

    try:
        root = ET.fromstring(text)  # noqa: S314  # expat limits what entities may become
    except (ET.ParseError, ValueError, LookupError) as error:
        raise BadPackageError(f"{manifest}: {error}") from error
    declared = (root.findtext("name") or name).strip()
    description = " ".join((root.findtext("description") or "").split())
    return Package(declared, manifest.parent, description, version=(root.findtext("version") or "").strip())
