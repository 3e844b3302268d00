"""Packages as their owners write and sign them."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

from rce.control.model import PackageSpec
from rce.packages.folder import look_into
from rce.packages.signing import SigningKey, statement

KEY = SigningKey.generate()


def write_package(folder: Path, name: str, **files: str) -> Path:
    """Write a package; a file's name may hold ``__`` for ``/``, its suffix is ``.py`` if it has none."""
    package = folder / name
    package.mkdir(parents=True, exist_ok=True)
    (package / "package.yaml").write_text(f"name: {name}\nversion: '1.0'\n")
    for key, text in files.items():
        path = package / key.replace("__", "/")
        path = path if path.suffix or path.name == "requirements" else path.with_suffix(".py")
        path = path.with_suffix(".txt") if path.name == "requirements" else path
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return package


def pack(package: Path) -> bytes:
    """The archive of a package."""
    archive = io.BytesIO()
    look_into(package, "1.0").pack(archive)
    return archive.getvalue()


def sign(archive: bytes, name: str, version: str, user: str = "user", key: SigningKey = KEY) -> PackageSpec:
    """What the master would say of a package."""
    sha256 = hashlib.sha256(archive).hexdigest()
    signature = key.sign(statement(user, name, version, sha256))
    return PackageSpec(name=name, version=version, sha256=sha256, signature=signature, key=key.public)
