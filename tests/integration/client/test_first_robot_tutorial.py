"""The tutorial's files do what the tutorial says."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.ports import free_ports

from rce.config.client import loads
from rce.ros.core import Core

TUTORIAL = Path(__file__).parents[3] / "docs" / "tutorials" / "first-robot.md"
FILE = re.compile(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", re.DOTALL)
SAID = "Hello Ada, from the cloud"


def write_files(folder: Path, url: str) -> None:
    for name, text in FILE.findall(TUTORIAL.read_text()):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace("http://127.0.0.1:9000/", url))
    (folder / "cloud/hello/package.yaml").write_text("python: engine\n")
    (folder / "cloud/hello/greeter.py").chmod(0o755)


@asynccontextmanager
async def program(
    *argv: str, folder: Path, ready: str = "", env: dict[str, str] | None = None
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a program; wait for the line that says it is ready."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        *argv,
        cwd=folder,
        env={**os.environ, **(env or {})},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(40):
            while ready and ready.encode() not in (line := await process.stdout.readline()):
                assert line, f"{argv} ended"
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
        async with asyncio.timeout(30):
            await process.communicate()


async def output(*argv: str, folder: Path, master: str = "") -> str:
    async with program(*argv, folder=folder, env={"ROS_MASTER_URI": master}) as process:
        async with asyncio.timeout(40):
            text, _ = await process.communicate()
        return text.decode()


@pytest.fixture
def short_folder() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(dir="/tmp"))  # sockets' paths are limited to 107 bytes
    yield folder
    shutil.rmtree(folder)


def test_the_config_is_valid(tmp_path: Path) -> None:
    write_files(tmp_path, "http://127.0.0.1:9000/")
    loads((tmp_path / "my-robot.config").read_text())


@pytest.mark.e2e
async def test_the_robot_gets_its_greeting(short_folder: Path) -> None:
    http, control, ws = free_ports(3)
    write_files(short_folder, f"http://127.0.0.1:{http}/")
    up = (
        *(
            str(Path(sys.executable).parent / "rce"),
            "up",
            "--dev",
            "--package-path",
            str(short_folder / "cloud"),
        ),
        *("--state-dir", str(short_folder / "state"), "--runtime", "process"),
        *("--http-port", str(http), "--control-port", str(control), "--ws-port", str(ws)),
        *("--robot-link-port", "0", "--container-link-port", "0"),
    )
    run_dir = {"XDG_RUNTIME_DIR": str(short_folder)}
    async with program(*up, folder=short_folder, ready="RCE ready", env=run_dir):
        assert SAID in await output("no_ros.py", folder=short_folder)
        async with Core(host="127.0.0.1", port=0) as core:
            bridge = ("-m", "rce_client.ros_bridge", "my-robot.config")
            ros = {"ROS_MASTER_URI": core.uri}
            async with program(*bridge, folder=short_folder, ready="rce-ros ready", env=ros) as process:
                assert SAID in await output("robot.py", folder=short_folder, master=core.uri)
                process.terminate()
                async with asyncio.timeout(60):
                    await process.communicate()
                assert process.returncode == 0
