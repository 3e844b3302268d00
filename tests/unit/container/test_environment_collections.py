"""How often the garbage collector of an environment looks at all objects."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import gc, pathlib, socket, sys
from rce_container.environment import messages, running

async def live(*_):
    before = gc.get_stats()[2]["collections"]
    interfaces = [[number] for number in range(400_000)]
    pathlib.Path(sys.argv[1], "full").write_text(str(gc.get_stats()[2]["collections"] - before))

running._live = live
boot = messages.Boot(
    id="u/c", mark="m", machine="m", home=sys.argv[1], logs=sys.argv[1], ros_port=0, isolated=False
)
running.run_environment(boot, *socket.socketpair())
"""


@pytest.mark.slow
def test_growing_environment_is_seldom_collected_as_a_whole(tmp_path: Path) -> None:
    """Each time its ROS core is held: the more interfaces there are, the longer."""
    subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path)], check=True, timeout=120)
    assert int((tmp_path / "full").read_text()) <= 1
