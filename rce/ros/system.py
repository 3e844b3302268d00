"""The environment variables of nodes that run with the machine's own Python and ROS."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

ROS_PREFIXES = Path("/opt/ros")
"""Where ROS distributions are installed; Debian's own ROS is in ``/usr``."""

_ENGINE_ONLY = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")


def system_environ(environ: Mapping[str, str], package: Path) -> dict[str, str]:
    """Return the variables of a node of a ROS package: with the machine's ``python3`` and its ROS.

    Args:
        environ: The environment of the engine's own nodes.
        package: The package's folder; selects the distribution that contains it.
    """
    engine = str(Path(sys.executable).parent)
    env = {name: value for name, value in environ.items() if name not in _ENGINE_ONLY}
    env["PATH"] = os.pathsep.join(
        folder for folder in environ.get("PATH", os.defpath).split(os.pathsep) if folder != engine
    )
    prefix = _distribution(package)
    return env if prefix is None else env | _distribution_environ(prefix, env["PATH"])


def _distribution(package: Path) -> Path | None:
    prefixes = sorted(path for path in ROS_PREFIXES.glob("*") if (path / "share").is_dir())
    holding = [path for path in prefixes if package.is_relative_to(path)]
    return next(iter(holding or prefixes), None)


def _distribution_environ(prefix: Path, path: str) -> dict[str, str]:
    """Return the variables that the distribution's ``setup.sh`` would set."""
    return {
        "PATH": f"{prefix / 'bin'}{os.pathsep}{path}",
        "PYTHONPATH": str(prefix / "lib" / "python3" / "dist-packages"),
        "LD_LIBRARY_PATH": str(prefix / "lib"),
        "CMAKE_PREFIX_PATH": str(prefix),
        "ROS_DISTRO": prefix.name,
        "ROS_ROOT": str(prefix / "share" / "ros"),
        "ROS_ETC_DIR": str(prefix / "etc" / "ros"),
    }
