"""The wheel with its base only, in an environment of its own: what a robot gets."""

from __future__ import annotations

import asyncio
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.engine import Program, running_engine
from support.ports import free_ports

ROOT = Path(__file__).parents[2]
ASK = ROOT / "tests" / "support" / "ask.py"
MOST_PACKAGES = 24
"""Distributions that the base brings, its own included."""

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(400), pytest.mark.xdist_group("base install")]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of an environment in which only the base is installed."""
    folder = tmp_path_factory.mktemp("base")
    # As `make wheel`, of this Python and without looking whether its packages are current.
    build = ["make", "--old-file", ".venv/.installed", f"BIN={Path(sys.executable).parent}", f"DIST={folder}"]
    environ = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    subprocess.run([*build, "wheel"], cwd=ROOT, check=True, capture_output=True, env=environ)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True)
    programs = folder / "venv" / "bin"
    pip(programs, "install", "--quiet", "--no-compile", str(wheel))
    return programs


def pip(programs: Path, *words: str) -> str:
    """Run this environment's pip for another one, and return what it prints."""
    argv = [sys.executable, "-m", "pip", "--python", str(programs / "python"), *words]
    return subprocess.run(argv, stdout=subprocess.PIPE, text=True, check=True).stdout


def environment(folder: Path, **more: str) -> dict[str, str]:
    kept = {
        key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_", "VIRTUAL"))
    }
    return kept | {"HOME": str(folder), "XDG_RUNTIME_DIR": str(folder), "COLUMNS": "200", **more}


def test_base_is_small(base: Path) -> None:
    names = {line.partition("==")[0].lower() for line in pip(base, "list", "--format", "freeze").split()}
    assert len(names) <= MOST_PACKAGES
    assert not names & {"aiohttp", "numpy", "pillow", "cryptography", "argon2-cffi", "pymunk"}


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        ("rce-master", "server"),
        ("rce-robot 10.0.0.1", "server"),
        ("rce-container 10.0.0.1", "server"),
        ("rce up --dev", "server"),
        ("rce ps", "server"),
        ("rce certificate init", "server"),
        ("rce ui fleet.config", "fleet"),
        ("rce sim", "fleet"),
        ("rce map log.bag", "fleet"),
        ("rce demo", "all"),
    ],
)
def test_command_of_a_missing_role_names_its_extra(
    base: Path, command: str, extra: str, tmp_path: Path
) -> None:
    program, *words = command.split()
    done = subprocess.run(
        [str(base / program), *words],
        env=environment(tmp_path),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert f"pip install 'rce[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_help_of_a_missing_role_names_its_extra(base: Path, tmp_path: Path) -> None:
    """Help is markup, where brackets would be left out."""
    done = subprocess.run(
        [str(base / "rce"), "sim", "--help"],
        env=environment(tmp_path),
        capture_output=True,
        text=True,
        check=True,
    )
    assert "rce[fleet]" in done.stdout


@pytest.mark.parametrize("program", ["rce", "rce-ros"])
def test_help_of_the_base_is_whole(base: Path, program: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [str(base / program), "--help"], env=environment(tmp_path), capture_output=True, text=True, check=True
    )
    assert "Usage" in done.stdout


async def test_robot_with_the_base_uses_its_container(base: Path, tmp_path: Path) -> None:
    """A message goes from the robot's ROS graph to a node in the cloud and back, without any extra."""
    (core_port,) = free_ports(1)
    async with running_engine() as engine:
        text = (ROOT / "configs/test.config").read_text()
        config = tmp_path / "robot.config"
        config.write_text(re.sub(r"http://localhost:9000/", engine.url, text))
        env = environment(tmp_path, ROS_MASTER_URI=f"http://127.0.0.1:{core_port}/")
        core = Program("core", [str(base / "rce"), "core", "--port", str(core_port)], env, tmp_path)
        bridge = Program("bridge", [str(base / "rce-ros"), str(config)], env, tmp_path)
        await core.start(ready="ready:", timeout=90)
        try:
            await bridge.start(ready="rce-ros ready:", timeout=120)
            asking = await asyncio.create_subprocess_exec(
                *(
                    "timeout",
                    "180",
                    str(base / "python"),
                    "-P",
                    str(ASK),
                    "/stringEchoReq",
                    "/stringEchoResp",
                ),
                env=env,
                stdout=asyncio.subprocess.PIPE,
            )
            output, _ = await asking.communicate()
            assert output.decode().strip() == "answer: hello", bridge.output()
            assert await bridge.stop() == 0
        finally:
            for program in (bridge, core):
                if program.running:
                    await program.stop()
