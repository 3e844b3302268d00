"""The program etcd of this machine, which keeps the state of several masters."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

MIN_VERSION = (3, 4)
"""The first release whose gateway is below ``/v3``."""
_VERSION = re.compile(r"etcd Version: (\d+)\.(\d+)")


class EtcdProgramError(Exception):
    """Etcd cannot be run on this machine; the text says why."""


def find_etcd() -> str:
    """Return the path of etcd. Blocks.

    Raises:
        EtcdProgramError: It is not installed, or too old.
    """
    needed = ".".join(map(str, MIN_VERSION))
    program = shutil.which("etcd")
    if program is None:
        raise EtcdProgramError(
            f"etcd is not installed; install release {needed} or later (Debian: etcd-server)"
        )
    done = subprocess.run([program, "--version"], check=False, capture_output=True, text=True)  # noqa: S603 - no input
    found = _VERSION.search(done.stdout)
    if found is None:
        raise EtcdProgramError(
            f"{program} --version does not tell a version of etcd: {json.dumps(done.stdout[:80])}"
        )
    if (int(found[1]), int(found[2])) < MIN_VERSION:
        raise EtcdProgramError(
            f"{program} is version {found[1]}.{found[2]}; version {needed} or later is needed"
        )
    return program
