"""Which nodes the cradle may start."""

from __future__ import annotations

import sys

import pytest

from rce_container.environment.cradle import fits

OWN = {"PATH": "/bin", "PYTHONPATH": "/engine"}


@pytest.mark.parametrize(
    ("argv", "env", "expected"),
    [
        ([sys.executable, "/p/node.py", "a"], OWN, True),
        ([sys.executable, "/p/node.py"], {**OWN, "PYTHONUNBUFFERED": "1", "ROS_IP": "1.2.3.4"}, True),
        ([sys.executable, "/p/node.py"], {**OWN, "PYTHONPATH": "/bundle:/engine"}, False),
        ([sys.executable, "/p/node.py"], {**OWN, "LD_PRELOAD": "/x.so"}, False),
        ([sys.executable, "/p/node.py"], {"PATH": "/bin"}, False),
        ([sys.executable, "-c", "print()"], OWN, False),
        ([sys.executable], OWN, False),
        (["/usr/bin/python3", "/p/node.py"], OWN, False),
        (["/p/node.py"], OWN, False),
    ],
)
def test_only_scripts_for_this_very_python(argv: list[str], env: dict[str, str], expected: bool) -> None:
    assert fits(argv, env, OWN) is expected
