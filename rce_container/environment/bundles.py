"""Which of the packages that the user brought are there yet, and what a node is started with because of it.

The manager puts each into the folder :attr:`rce_container.environment.messages.Boot.bundles`, as
``SHA256/NAME``; it appears whole.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec

from rce.bundles.versions import newest, split_package
from rce.control.model import BundleSpec, EndpointSpec, InterfaceSpec, NodeSpec
from rce.ros.packages import PATH_VARIABLES, PackageIndex

REQUIREMENTS = ".requirements"
"""Folder beside a package, with what its ``requirements.txt`` asked for."""


class LaunchEnvironment(NamedTuple):
    """What a node is started with."""

    spec: NodeSpec
    """The node; its package without a version."""
    packages: PackageIndex
    environ: dict[str, str]
    python_path: str = ""
    """Folder with Python modules that the node's package asked for; empty for none."""


class Bundles:
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
        self._wanted: tuple[BundleSpec, ...] = ()
        self.index = PackageIndex(self._packages)

    def apply(self, wanted: tuple[BundleSpec, ...]) -> None:
        """Take over what is desired, and look at what is there."""
        self._wanted = wanted
        self.look()

    def look(self) -> None:
        """Look at what is there."""
        self.index.path = self._path(None)

    @property
    def is_waiting(self) -> bool:
        """Whether something is still to come."""
        return not all(map(self._is_there, self._wanted))

    def lacking(self, nodes: Iterable[NodeSpec]) -> dict[str, str]:
        """Tell which nodes cannot start because their package is still to come, and say so in words."""
        texts = {}
        for node in nodes:
            bundle = self._find(node.pkg)
            if bundle is not None and not self._is_there(bundle):
                texts[node.tag] = f"waits for its package {bundle.name} {bundle.version}"
        return texts

    def hold_back(self, spec: EndpointSpec, before: Collection[InterfaceSpec]) -> EndpointSpec:
        """Leave out interfaces whose type may be in a package that is still to come, with what hangs on them.

        Args:
            spec: What is desired.
            before: Interfaces that are there; they stay.
        """
        coming = {bundle.name for bundle in self._wanted if not self._is_there(bundle)}
        if not coming:
            return spec
        kept = tuple(
            interface
            for interface in spec.interfaces
            if interface in before or interface.cls.partition("/")[0] not in coming
        )
        tags = {interface.tag for interface in kept}
        connections = tuple(one for one in spec.connections if one.interface in tags)
        return msgspec.structs.replace(spec, interfaces=kept, connections=connections)

    def outfit(self, node: NodeSpec, environ: Mapping[str, str]) -> LaunchEnvironment:
        """Work out what a node is started with.

        Args:
            node: The node.
            environ: The environment of all nodes.
        """
        bundle = self._find(node.pkg)
        path = self._path(bundle)
        joined = os.pathsep.join(map(str, path))
        env = {**environ, **dict.fromkeys(PATH_VARIABLES, joined)}
        if bundle is None:
            return LaunchEnvironment(node, PackageIndex(path), env)
        requirements = self._root(bundle) / REQUIREMENTS
        return LaunchEnvironment(
            msgspec.structs.replace(node, pkg=bundle.name),
            PackageIndex(path),
            env,
            str(requirements) if requirements.is_dir() else "",
        )

    def _find(self, pkg: str) -> BundleSpec | None:
        """Find what a node names; None if its user brought no such package."""
        name, version = split_package(pkg)
        fitting = [one for one in self._wanted if one.name == name and version in ("", one.version)]
        return newest(fitting, lambda one: one.version)

    def _path(self, first: BundleSpec | None) -> tuple[Path, ...]:
        """The package path: of one bundle, of the newest ones of each name, of the others, of the machine."""
        names = dict.fromkeys(bundle.name for bundle in self._wanted)
        chosen = [first, *map(self._find, names), *self._wanted]
        roots = [self._root(bundle) for bundle in chosen if bundle is not None and self._is_there(bundle)]
        return tuple(dict.fromkeys([*roots, *map(Path, self._packages)]))

    def _is_there(self, bundle: BundleSpec) -> bool:
        return self._root(bundle).is_dir()

    def _root(self, bundle: BundleSpec) -> Path:
        return self._folder / bundle.sha256
