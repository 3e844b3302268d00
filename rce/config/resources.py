"""Finds files that ship with the project, in a checkout or an installed package."""

from __future__ import annotations

from pathlib import Path

import rce
from rce.config.exceptions import ShippedFileError

_PACKAGE = Path(rce.__file__).resolve().parent


def examples_dir() -> Path:
    """Return the folder of example packages.

    Raises:
        ShippedFileError: It was not shipped.
    """
    return _find("examples")


def configs_dir() -> Path:
    """Return the folder of example configs and default settings.

    Raises:
        ShippedFileError: It was not shipped.
    """
    return _find("configs")


def _find(name: str) -> Path:
    # A wheel holds the folders inside the package; a checkout has them beside it.
    candidates = (_PACKAGE / "share" / name, _PACKAGE.parent / name)
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise ShippedFileError(f"folder {name!r} is neither {candidates[0]} nor {candidates[1]}")
