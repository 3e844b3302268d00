"""Packages that users bring: their versions, and the keys by which these are signed.

The contents of a version are kept elsewhere, under its hash; this module keeps its record.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import chain, islice
from typing import TYPE_CHECKING

from rce.control import PackageSpec
from rce.model import NodeSpec, is_name, is_version, newest, split_package
from rce.packages import key_id
from rce_master.exceptions import ConflictError, InvalidRequestError, LimitReachedError, NotFoundError
from rce_master.state import limits
from rce_master.state.records import Container
from rce_master.state.user_records import UserPackage, package_key_key, user_package_key

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rce_master.state.changes import Transaction
    from rce_master.state.commands import AddPackage, AddPackageKey, RemovePackage, RemovePackageKey
    from rce_master.state.package_uses import Named
    from rce_master.state.settings import StateSettings
    from rce_master.state.tables import Tables

SHOWN = 10
"""How many nodes that need a version are named; others are counted."""


def add_key(tx: Transaction, command: AddPackageKey) -> None:
    """Trust a key; a trusted one is accepted silently."""
    key = command.key
    if key.user not in tx.tables.users:
        raise NotFoundError(f"there is no user {key.user!r}")
    if key.id in tx.tables.package_keys:
        return
    if tx.tables.package_keys.count("user", key.user) >= tx.settings.max_package_keys:
        raise LimitReachedError(f"you have {tx.settings.max_package_keys} keys already; revoke one first")
    tx.put(key)
    tx.happen("package_key_registered", f"{key.user}/{key_id(key.key)}", key.label)


def remove_key(tx: Transaction, command: RemovePackageKey) -> None:
    """Stop trusting a key. Packages that it signed before stay until they are removed."""
    found = [key for key in tx.tables.package_keys.by("user", command.user) if key_id(key.key) == command.id]
    if not found:
        raise NotFoundError(f"you have no key {command.id!r}")
    tx.delete(tx.tables.package_keys, found[0].id)
    tx.happen("package_key_revoked", f"{command.user}/{command.id}")


def check_new(tables: Tables, package: UserPackage) -> bool:
    """Return whether a version is new; an identical one is not.

    Raises:
        InvalidRequestError: Its name or version cannot be one.
        NotFoundError: Its key is not registered.
        ConflictError: The same version exists with other contents.
    """
    if not is_name(package.name) or not is_version(package.version):
        raise InvalidRequestError(
            f"{package.name}@{package.version} cannot be the name and the version of a package"
        )
    if package_key_key(package.user, package.key) not in tables.package_keys:
        raise NotFoundError(
            f"the key {key_id(package.key)} is not registered with your account, or was revoked;"
            " run: rce package key register"
        )
    there = tables.packages.get(package.id)
    if there is not None and there.digest != package.digest:
        raise ConflictError(
            f"{package.name} {package.version} is there with other contents, and a version never"
            " changes; give this one another version, or remove that one first"
        )
    return there is None


def add_package(tx: Transaction, command: AddPackage) -> None:
    """Store a version; an identical one is accepted silently. Containers that name the package get it."""
    package = command.package
    if package.user not in tx.tables.users:
        raise NotFoundError(f"there is no user {package.user!r}")
    if not check_new(tx.tables, package):
        return
    check_room(tx.tables, tx.settings, package.user, package.packed, package.size)
    tx.put(package)
    _touch_users_of(tx, package)
    tx.happen("package_pushed", package.id)


def check_room(tables: Tables, settings: StateSettings, user: str, packed: int, size: int = 0) -> None:
    """Check that a user may keep one more version.

    Args:
        tables: What there is.
        settings: The limits.
        user: Whose it is.
        packed: Bytes of its archive.
        size: Bytes of its files, as far as they are known.

    Raises:
        LimitReachedError: There are too many, or they are too large.
    """
    limits.check_packages(tables, settings, user, size)
    held = packed + sum(package.packed for package in tables.packages.by("user", user))
    if held > settings.max_package_bytes:
        raise LimitReachedError(
            f"the archives of your packages would have {held} bytes, {settings.max_package_bytes} are"
            " allowed; remove a version first"
        )


def remove_package(tx: Transaction, command: RemovePackage) -> None:
    """Remove a version that no node needs."""
    found = tx.tables.packages.get(user_package_key(command.user, command.name, command.version))
    if found is None:
        raise NotFoundError(f"there is no package {command.name!r} of version {command.version!r}")
    used = uses(tx.tables, found, is_newest=find(tx.tables, found.user, found.name) == found)
    if used.count:
        raise ConflictError(
            f"{found.name} {found.version} is used by {used}; remove the nodes first, or let them name"
            " another version"
        )
    tx.delete(tx.tables.packages, found.id)
    tx.happen("package_removed", found.id)


def forget_user(tx: Transaction, user: str) -> None:
    """Remove a user's packages and keys."""
    for package in tx.tables.packages.by("user", user):
        tx.delete(tx.tables.packages, package.id)
    for key in tx.tables.package_keys.by("user", user):
        tx.delete(tx.tables.package_keys, key.id)


def find(tables: Tables, user: str, pkg: str) -> UserPackage | None:
    """Return the version that a node names, or the newest; None if the user brought none."""
    name, version = split_package(pkg)
    if version:
        return tables.packages.get(user_package_key(user, name, version))
    return newest(tables.packages.by("package", f"{user}/{name}"), lambda package: package.version)


def _finder(tables: Tables, user: str) -> Callable[[str], UserPackage | None]:
    """Return a cached :func:`find`: many nodes name the same package, and there may be many versions."""
    return cache(lambda pkg: find(tables, user, pkg))


@dataclass(frozen=True, slots=True)
class Uses:
    """The nodes that need a version."""

    count: int
    first: tuple[str, ...]
    """Some of them, each ``CONTAINER/NODE``."""

    def __str__(self) -> str:
        more = self.count - len(self.first)
        return ", ".join(self.first) + (f", and {more} more" if more else "")


def uses(tables: Tables, package: UserPackage, *, is_newest: bool) -> Uses:
    """Return which nodes need a version, in a time that does not grow with the number of other nodes.

    Args:
        tables: The tables.
        package: The version.
        is_newest: Whether nodes that name no version get this one.
    """
    versions = (package.version, "") if is_newest else (package.version,)
    named = [(package.user, package.name, version) for version in versions]
    count = sum(map(tables.package_uses.count, named))
    return Uses(count, tuple(islice(chain.from_iterable(_nodes_of(tables, one) for one in named), SHOWN)))


def _nodes_of(tables: Tables, named: Named) -> Iterator[str]:
    for id_ in tables.package_uses.containers(named):
        container = tables.container(id_)
        assert container is not None
        for node in container.nodes.values():
            if (container.user, *split_package(node.pkg)) == named:
                yield f"{container.tag}/{node.tag}"


def check_node(tables: Tables, user: str, node: NodeSpec) -> None:
    """Check that the version which a node names exists.

    Raises:
        NotFoundError: It does not exist.
    """
    name, version = split_package(node.pkg)
    if version and find(tables, user, node.pkg) is None:
        raise NotFoundError(
            f"node {node.tag!r}: you have no package {name!r} of version {version!r}; see: rce package list"
        )


def package_specs(tables: Tables, container: Container) -> tuple[PackageSpec, ...]:
    """Return the packages that the nodes of a container need, in the order of names and versions."""
    found = map(_finder(tables, container.user), [node.pkg for node in container.nodes.values()])
    needed = {package.id: package for package in found if package is not None}
    return tuple(_spec(needed[id_]) for id_ in sorted(needed))


def _spec(package: UserPackage) -> PackageSpec:
    return PackageSpec(
        name=package.name,
        version=package.version,
        sha256=package.sha256,
        signature=package.signature,
        key=package.key,
    )


def _touch_users_of(tx: Transaction, package: UserPackage) -> None:
    for id_ in list(tx.tables.package_uses.containers((package.user, package.name, ""))):
        tx.touch(id_)
