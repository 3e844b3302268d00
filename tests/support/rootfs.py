"""A small root file system, made of this machine's programs; for tests of images."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path

_LIBRARY = re.compile(r"(/\S+)(?= \(0x)")
_STDLIB_LEFT_OUT = (
    "test",
    "idlelib",
    "ensurepip",
    "lib2to3",
    "distutils",
    "pydoc_data",
    "__pycache__",
    "config-*",
)


@contextlib.contextmanager
def image_of(rootfs: Path) -> Iterator[str]:
    """Have a root file system as an image in podman's store; gives its name."""
    name = f"localhost/rce-test-{os.getpid()}-{secrets.token_hex(4)}:1"
    tar = subprocess.run(["tar", "-C", str(rootfs), "-c", "."], capture_output=True, check=True).stdout
    subprocess.run(["podman", "import", "-q", "-", name], input=tar, capture_output=True, check=True)
    try:
        yield name
    finally:
        subprocess.run(["podman", "rmi", name], capture_output=True, check=True)


def make_rootfs(folder: Path, programs: Iterable[str] = ("sh", "cat"), *, python: bool = False) -> None:
    """Make a root file system.

    Args:
        folder: Is made.
        programs: What is in its ``/bin``, with the libraries that they need.
        python: Whether the machine's ``python3`` is in it, with a part of its standard library.
    """
    (folder / "bin").mkdir(parents=True)
    for name in ("etc", "proc", "dev", "sys", "tmp", "root"):
        (folder / name).mkdir()
    (folder / "etc" / "rootfs-release").write_text("made by a test\n")
    found = [Path(shutil.which(name, path="/bin:/usr/bin") or name) for name in programs]
    for program in found:
        shutil.copy(program, folder / "bin")
    if python:
        found += _copy_python(folder)
    listing = subprocess.run(["ldd", *map(str, found)], capture_output=True, text=True, check=True).stdout
    for library in sorted(set(_LIBRARY.findall(listing))):
        target = folder / library.lstrip("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(library, target)


def _copy_python(folder: Path) -> list[Path]:
    """Copy ``/usr/bin/python3``; returns the files whose libraries it needs."""
    program = Path("/usr/bin/python3").resolve()
    (folder / "usr" / "bin").mkdir(parents=True)
    shutil.copy(program, folder / "usr" / "bin" / "python3")
    library = Path("/usr/lib") / program.name
    shutil.copytree(
        library, folder / "usr" / "lib" / program.name, ignore=shutil.ignore_patterns(*_STDLIB_LEFT_OUT)
    )
    return [program, *(library / "lib-dynload").glob("*.so")]
