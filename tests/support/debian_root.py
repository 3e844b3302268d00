"""A root file system of this machine's Debian packages; one of debootstrap costs a minute of CPU."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

_FIELDS = ("Package", "Essential", "Provides", "Pre-Depends", "Depends")
_LEFT_OUT = re.compile(r"/usr/share/(doc|info|locale|lintian|man|zoneinfo)/")
_MADE_BY_SCRIPTS = ("/etc/passwd", "/etc/group", "/etc/ld.so.cache", "/etc/ssl/certs/ca-certificates.crt")
"""Files of no package, which programs need."""


def make_debian_root(folder: Path, packages: Iterable[str]) -> None:
    """Copy the files of the essential packages, of the given ones, and of all that they depend on.

    Args:
        folder: Is made.
        packages: Names of packages that are installed here.
    """
    folder.mkdir()
    for name in ("dev", "proc", "root", "run", "sys", "tmp"):
        (folder / name).mkdir()
    for link in ("bin", "lib", "lib32", "lib64", "libx32", "sbin"):
        if (Path("/") / link).is_symlink():
            (folder / link).symlink_to((Path("/") / link).readlink())
    names = sorted(_with_what_they_need(packages))
    listing = subprocess.run(["dpkg-query", "-L", *names], capture_output=True, text=True, check=True).stdout
    paths = {_place(Path(line)) for line in listing.splitlines() if line.startswith("/")}
    kept = sorted(str(path) for path in paths if path.is_symlink() or path.exists())
    wanted = "\0".join(f".{path}" for path in kept if not _LEFT_OUT.match(path))
    taking = ["tar", "-C", "/", "-c", "--no-recursion", "--null", "-T", "-"]
    packed = subprocess.run(taking, input=wanted.encode(), capture_output=True, check=True).stdout
    subprocess.run(["tar", "-C", str(folder), "-x", "--keep-directory-symlink"], input=packed, check=True)
    for path in map(Path, _MADE_BY_SCRIPTS):
        target = folder / path.relative_to("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)


def _place(path: Path) -> Path:
    """Return where a file of a package lies, as packages may name it through ``/bin`` or ``/lib``."""
    return path.parent.resolve() / path.name


def _with_what_they_need(packages: Iterable[str]) -> set[str]:
    form = "\t".join(f"${{{field}}}" for field in _FIELDS) + "\n"
    listing = subprocess.run(["dpkg-query", "-W", "-f", form], capture_output=True, text=True, check=True)
    waiting = list(packages)
    needs: dict[str, list[list[str]]] = {}
    providers: dict[str, str] = {}
    for line in listing.stdout.splitlines():
        name, essential, provided, *needed = line.split("\t")
        needs[name] = [_names(group) for field in needed for group in field.split(",")]
        for virtual in (name, *_names(provided.replace(",", "|"))):
            providers.setdefault(virtual, name)
        if essential == "yes":
            waiting.append(name)
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        found.add(name)
        for group in needs[name]:
            waiting += [providers[one] for one in group if one in providers][:1]
    return found


def _names(alternatives: str) -> list[str]:
    """Return the packages of ``a (>= 1) | b:any``."""
    return [one.split()[0].partition(":")[0] for one in alternatives.split("|") if one.strip()]
