"""What of cgroups of version 2 the kernel does even where its important controllers belong to version 1."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.containers import until

from rce_container.limits import files, hierarchy
from rce_container.limits.cgroup2 import ControlGroupV2

pytestmark = pytest.mark.needs("root")

JOIN = 'for file; do echo $$ >"$file"; done; echo in; exec sleep 600'


@pytest.fixture
def base() -> Iterator[Path]:
    """A cgroup that is the test's own."""
    own = next((one for one in hierarchy.find() if one.version == 2), None)
    if own is None:
        pytest.skip("no hierarchy of version 2 is mounted")
    base = own.folder / f"rce-test-{os.getpid()}"
    try:
        files.make(base)
    except OSError as error:
        pytest.skip(f"no cgroup of version 2 can be made here: {error}")
    yield base
    ControlGroupV2([base]).remove()


def start(*argv: str) -> subprocess.Popen[str]:
    return subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


async def test_the_kernel_kills_all_of_a_cell_at_once(base: Path) -> None:
    files.make(base / "m1")
    files.make(base / "m1" / "inner")
    control_group, inner = ControlGroupV2([base / "m1"]), ControlGroupV2([base / "m1" / "inner"])
    victims = [start("/bin/sh", "-c", JOIN, "sh", *one.join) for one in (control_group, inner, control_group)]
    for victim in victims:
        assert victim.stdout is not None
        assert victim.stdout.readline() == "in\n"
    assert sorted(control_group.pids()) == sorted(victim.pid for victim in victims)
    usage = control_group.usage()
    assert usage.cpu_s is not None, "the kernel counts time without a controller"
    control_group.kill()
    for victim in victims:
        victim.communicate()
        assert victim.returncode == -signal.SIGKILL
    await until(lambda: not control_group.pids())
    control_group.remove()
    assert not (base / "m1").exists()
