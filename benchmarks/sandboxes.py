"""The start time of other sandboxes with namespaces, for comparison with the engine's containers."""

from __future__ import annotations

import asyncio
import shutil
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

from benchmarks.figures import spread
from rce_container.runtimes.base import clean_environ
from rce_container.runtimes.namespace import interpreter_paths

TRUE = ("/bin/sh", "-c", "echo")
NODE = (sys.executable, "-c", "import rce.ros.node; print()")
"""The modules that the engine's nodes import at their start."""

# crun refuses machines that have controllers in cgroups of both versions: one is hidden from it.
_PODMAN = """
[ ! -d /sys/fs/cgroup/unified ] || mount -t tmpfs tmpfs /sys/fs/cgroup/unified
exec podman run --rm --network=none --cgroups=disabled --ulimit=nofile=1024:1024 --ulimit=nproc=1024:1024 "$@"
"""


async def start_times(*, count: int) -> list[dict[str, Any]]:
    """Start -> first line of output, for bare bubblewrap and podman, with a shell and with a Python node."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="rce-bench-", dir="/tmp") as folder:
        for name, prefix in (("bwrap", _bwrap()), ("podman run --rootfs", _podman(Path(folder)))):
            for what, program in (("a shell", TRUE), ("Python that imports rce.ros.node", NODE)):
                label = f"{name}: {what}"
                if shutil.which(name.split()[0]) is None:
                    rows.append({"start -> first line": label, "why not": "it is not installed"})
                else:
                    rows.append({"start -> first line": label, **await _measure([*prefix, *program], count)})
    names = list(dict.fromkeys(name for row in rows for name in row))
    return [{name: row.get(name, "") for name in names} for row in rows]


async def _measure(argv: list[str], count: int) -> dict[str, Any]:
    times = []
    for _ in range(count):
        start = perf_counter()
        process = await asyncio.create_subprocess_exec(
            *argv,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=clean_environ("/tmp"),
        )
        assert process.stdout is not None
        line = await process.stdout.readline()
        times.append(perf_counter() - start)
        _, errors = await process.communicate()
        if not line:
            return {"why not": errors.decode(errors="replace").strip().rpartition("\n")[2]}
    return spread(times)


def _bwrap() -> list[str]:
    return ["bwrap", "--unshare-all", "--ro-bind", "/", "/", "--proc", "/proc", "--dev", "/dev", "--"]


def _podman(folder: Path) -> list[str]:
    for name in ("usr", "proc", "sys", "dev", "tmp", "etc", "run"):
        (folder / name).mkdir()
    for name in ("bin", "lib", "lib64"):
        (folder / name).symlink_to(f"usr/{name}")
    volumes = [f"--volume={path}:{path}:ro" for path in dict.fromkeys((Path("/usr"), *interpreter_paths()))]
    variables = [f"--env={name}={value}" for name, value in clean_environ("/tmp").items()]
    return [
        "unshare",
        "--mount",
        "sh",
        "-c",
        _PODMAN,
        "podman",
        *volumes,
        *variables,
        "--rootfs",
        str(folder),
    ]
