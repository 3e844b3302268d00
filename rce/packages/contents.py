"""The contents of a package: its manifest, and its executables."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from msgspec import Struct

from rce.model import is_name
from rce.packages import requirements
from rce.packages.archive import read_archive
from rce.packages.exceptions import BadArchiveError
from rce.packages.limits import DEFAULT_LIMITS, ArchiveLimits
from rce.packages.tree import Entry, Kind, Tree
from rce.ros.errors import BadPackageError
from rce.ros.packages import FOLDERS, MANIFESTS, Package, parse_manifest

_DEFINITIONS = ("msg", "srv", "action")
_SHOWN = 100
_AT_TOP = 2
"""Parts of the path of a file in the package's folder itself."""
_MAX_DESCRIPTION = 1000


class Contents(Struct, frozen=True, kw_only=True):
    """The contents of a package."""

    name: str
    version: str = ""
    """As in the manifest; empty if it has none."""
    description: str = ""
    python: str = "system"
    """See :class:`rce.ros.packages.Package`."""
    executables: tuple[str, ...] = ()
    """The executables that a node can name as ``exe``; the first hundred."""
    requirements: bool = False
    """Whether it has a ``requirements.txt``."""
    files: int = 0
    size: int = 0
    """Bytes of all files."""
    digest: str = ""
    """SHA-256, in hex, of what the archive unpacks to."""
    warnings: tuple[str, ...] = ()
    """Probable mistakes."""


def inspect(file: BinaryIO, limits: ArchiveLimits = DEFAULT_LIMITS) -> Contents:
    """Read an archive and return its contents. Blocks; unpacks nothing to a disk.

    Raises:
        BadArchiveError: It is not a package's archive.
    """
    texts: dict[str, bytes] = {}

    def visit(entry: Entry, data: Iterator[bytes]) -> None:
        inner = entry.parts[1:]
        if entry.kind is Kind.FILE and len(inner) == 1 and inner[0] in _TEXTS:
            if entry.size > limits.manifest:
                raise BadArchiveError(f"{entry.path!r}: it has more than {limits.manifest} bytes")
            texts[inner[0]] = b"".join(data)

    tree, digest = read_archive(file, visit, limits)
    return describe(tree, texts, digest)


_TEXTS = (*MANIFESTS, requirements.FILE_NAME)


def describe(tree: Tree, texts: dict[str, bytes], digest: str = "") -> Contents:
    """Return the contents of a tree.

    Args:
        tree: All entries.
        texts: The manifest and ``requirements.txt``, by their names, as far as they are there.
        digest: See :attr:`Contents.digest`.

    Raises:
        BadArchiveError: The manifest is missing, cannot be read, or names another package.
    """
    package = _package(tree, texts)
    executables = tuple(_executables(tree, package))
    return Contents(
        name=package.name,
        version=package.version,
        description=package.description[:_MAX_DESCRIPTION],
        python=package.python,
        executables=executables[:_SHOWN],
        requirements=requirements.FILE_NAME in texts,
        files=tree.files,
        size=tree.size,
        digest=digest,
        warnings=tuple(_warnings(tree, package, executables, texts.get(requirements.FILE_NAME, b""))),
    )


def _package(tree: Tree, texts: dict[str, bytes]) -> Package:
    for manifest in MANIFESTS:
        if manifest in texts:
            break
    else:
        raise BadArchiveError(f"there is no {' or '.join(MANIFESTS)} at the top of the folder")
    try:
        package = parse_manifest(Path(manifest), texts[manifest], tree.name)
    except BadPackageError as error:
        raise BadArchiveError(str(error)) from error
    if not is_name(package.name):
        raise BadArchiveError(
            f"{manifest}: {package.name!r} cannot be named by a node: use letters, digits and '_', a letter"
            " first"
        )
    if package.name != tree.name:
        raise BadArchiveError(
            f"{manifest}: it names the package {package.name!r}, but its folder is {tree.name!r}"
        )
    return package


def _executables(tree: Tree, package: Package) -> Iterator[str]:
    for entry in tree.entries.values():
        name = entry.parts[-1]
        if entry.kind is not Kind.FILE or len(entry.parts) == 1:
            continue
        is_run = package.python == "engine" and name.endswith(".py") and _is_usual(entry)
        if is_run or (entry.executable and not any(part.startswith(".") for part in entry.parts[1:-1])):
            yield name


def _candidates(tree: Tree) -> Iterator[Entry]:
    for entry in tree.entries.values():
        if entry.kind is Kind.FILE and len(entry.parts) > 1 and _is_usual(entry):
            yield entry


def _is_usual(entry: Entry) -> bool:
    """Return whether a file is in a folder for nodes."""
    return "/".join(entry.parts[1:-1]) in FOLDERS


def _warnings(tree: Tree, package: Package, executables: tuple[str, ...], wanted: bytes) -> Iterator[str]:
    definitions = any(f"{tree.name}/{kind}" in tree.entries for kind in _DEFINITIONS)
    if not executables and not definitions:
        yield (
            "no node can be made of it: there is no executable file in it, and in the folder itself,"
            f" {', '.join(filter(None, FOLDERS))} no file that the engine's Python runs"
        )
    if package.python == "system":
        for entry in _candidates(tree):
            is_meant = len(entry.parts) > _AT_TOP or not executables
            if is_meant and entry.path.endswith(".py") and not entry.executable:
                yield f"{'/'.join(entry.parts[1:])} may not be executed, so no node can name it (chmod +x)"
    yield from requirements.read_requirements(wanted.decode("utf-8", "replace")).faults
