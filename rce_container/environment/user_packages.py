"""The packages that the user brought and that have arrived, and the launch environment of nodes.

The manager puts each into the folder :attr:`rce_container.environment.messages.Boot.user_packages`, as
``SHA256/NAME``; it appears whole.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec

from rce.control import EndpointSpec, PackageSpec
from rce.model import InterfaceSpec, NodeSpec, newest, split_package
from rce.ros.packages import PATH_VARIABLES, PackageIndex

REQUIREMENTS = ".requirements"
"""Folder beside a package, with the modules that its ``requirements.txt`` asked for."""


class LaunchEnvironment(NamedTuple):
    """The launch environment of a node."""

    spec: NodeSpec
    """The node; its package without a version."""
    packages: PackageIndex
    environ: dict[str, str]
    python_path: str = ""
    """Folder with Python modules that the node's package asked for; empty for none."""


class UserPackages:
    """The packages that a container's user brought.

    Args:
        folder: Where the manager puts them.
        packages: The machine's folders of packages; they come after the user's.

    Attributes:
        index: Finds packages for the container as a whole.
    """

    def __init__(self, folder: str, packages: Iterable[str]) -> None:
        self._folder = Path(folder)
        self._packages = tuple(packages)
        self._wanted: tuple[PackageSpec, ...] = ()
        self.index = PackageIndex(self._packages)

    def apply(self, wanted: tuple[PackageSpec, ...]) -> None:
        """Apply the desired packages, and check which have arrived."""
        self._wanted = wanted
        self.look()

    def look(self) -> None:
        """Check which packages have arrived."""
        self.index.path = self._path(None)

    @property
    def is_waiting(self) -> bool:
        """Whether a package has yet to arrive."""
        return not all(map(self._is_there, self._wanted))

    def lacking(self, nodes: Iterable[NodeSpec]) -> dict[str, str]:
        """Return the nodes whose package has yet to arrive, each with a text about it."""
        texts = {}
        for node in nodes:
            package = self._find(node.pkg)
            if package is not None and not self._is_there(package):
                texts[node.tag] = f"waits for its package {package.name} {package.version}"
        return texts

    def hold_back(self, spec: EndpointSpec, before: Collection[InterfaceSpec]) -> EndpointSpec:
        """Leave out interfaces whose type may be in a package yet to arrive, with their connections.

        Args:
            spec: The desired state.
            before: Interfaces that exist; they stay.
        """
        coming = {package.name for package in self._wanted if not self._is_there(package)}
        if not coming:
            return spec
        kept = tuple(
            interface
            for interface in spec.interfaces
            if interface in before or interface.message_type.partition("/")[0] not in coming
        )
        tags = {interface.tag for interface in kept}
        with_itself = {link.id for link in spec.links if link.peer == spec.id}
        connections = tuple(
            one
            for one in spec.connections
            if one.interface in tags and (one.link not in with_itself or one.peer_interface in tags)
        )
        return msgspec.structs.replace(spec, interfaces=kept, connections=connections)

    def launch_environment(self, node: NodeSpec, environ: Mapping[str, str]) -> LaunchEnvironment:
        """Return the launch environment of a node.

        Args:
            node: The node.
            environ: The environment of all nodes.
        """
        package = self._find(node.pkg)
        path = self._path(package)
        joined = os.pathsep.join(map(str, path))
        env = {**environ, **dict.fromkeys(PATH_VARIABLES, joined)}
        if package is None:
            return LaunchEnvironment(node, PackageIndex(path), env)
        requirements = self._root(package) / REQUIREMENTS
        return LaunchEnvironment(
            msgspec.structs.replace(node, pkg=package.name),
            PackageIndex(path),
            env,
            str(requirements) if requirements.is_dir() else "",
        )

    def _find(self, pkg: str) -> PackageSpec | None:
        """Return the package that a node names; None if its user brought no such package."""
        name, version = split_package(pkg)
        fitting = [one for one in self._wanted if one.name == name and version in ("", one.version)]
        return newest(fitting, lambda one: one.version)

    def _path(self, first: PackageSpec | None) -> tuple[Path, ...]:
        """Return the package path: one package, the newest of each name, the others, the machine's."""
        names = dict.fromkeys(package.name for package in self._wanted)
        chosen = [first, *map(self._find, names), *self._wanted]
        roots = [self._root(package) for package in chosen if package is not None and self._is_there(package)]
        return tuple(dict.fromkeys([*roots, *map(Path, self._packages)]))

    def _is_there(self, package: PackageSpec) -> bool:
        return self._root(package).is_dir()

    def _root(self, package: PackageSpec) -> Path:
        return self._folder / package.sha256
