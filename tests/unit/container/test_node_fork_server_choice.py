"""Which nodes the node fork server may start."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rce_container.environment.nodes.fork_server import fits

OWN = {"PATH": "/bin", "PYTHONPATH": "/engine"}


@pytest.mark.parametrize(
    ("argv", "env", "expected"),
    [
        ([sys.executable, "/p/node.py", "a"], OWN, True),
        ([sys.executable, "/p/node.py"], {**OWN, "PYTHONUNBUFFERED": "1", "ROS_IP": "1.2.3.4"}, True),
        ([sys.executable, "/p/node.py"], {**OWN, "PYTHONPATH": "/package:/engine"}, False),
        ([sys.executable, "/p/node.py"], {**OWN, "LD_PRELOAD": "/x.so"}, False),
        ([sys.executable, "/p/node.py"], {"PATH": "/bin"}, False),
        ([sys.executable, "-c", "print()"], OWN, False),
        ([sys.executable], OWN, False),
        (["/usr/bin/python3", "/p/node.py"], OWN, False),
        (["/p/node.py"], OWN, False),
    ],
)
def test_only_scripts_for_this_very_python(
    tmp_path: Path, argv: list[str], env: dict[str, str], expected: bool
) -> None:
    argv = [word.replace("/p/", f"{tmp_path}/") for word in argv]
    assert fits(argv, env, OWN) is expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [("helpers.py", True), ("json.py", False), ("yaml", False), ("asyncio.cpython-311-x86_64.so", False)],
)
def test_not_if_the_scripts_folder_hides_a_module(tmp_path: Path, name: str, expected: bool) -> None:
    import yaml  # noqa: F401 - as the environment does

    (tmp_path / name).touch()
    assert fits([sys.executable, str(tmp_path / "node.py")], OWN, OWN) is expected


def test_not_if_the_scripts_folder_cannot_be_read(tmp_path: Path) -> None:
    assert not fits([sys.executable, str(tmp_path / "none" / "node.py")], OWN, OWN)
