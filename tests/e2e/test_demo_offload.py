"""``rce demo --offload``: localization and navigation run in the robots' containers."""

from __future__ import annotations

import asyncio
import sys

import pytest
from support.demo import clean_folder, environment, run_headless

pytestmark = [pytest.mark.e2e, pytest.mark.real_time("robots"), pytest.mark.needs("pymunk")]

TIMEOUT_S = 400.0


@pytest.mark.timeout(600)
async def test_offloaded_robot_is_replanned_and_arrives() -> None:
    code, report, text = await run_headless(
        *("--offload", "--robots", 1, "--seed", 11, "--runtime", "process"), timeout=TIMEOUT_S
    )
    assert code == 0, text
    (robot,) = report["robots"]
    assert robot["reached"] is True
    assert robot["replans"] >= 1
    assert robot["distance_m"] > 0.5
    assert 0 < robot["localization_rmse_m"] <= robot["localization_max_m"] < 0.5
    assert report["collisions"] == 0
    assert report["mode"] == "cloud"
    assert report["blocked_cell"] is not None


@pytest.mark.parametrize("mode", ["single", "multi"])
async def test_offload_without_containers_is_refused(mode: str) -> None:
    with clean_folder() as folder:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rce_fleet.demo", "--headless", "--offload", "--mode", mode),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=environment(folder),
        )
        output, _ = await process.communicate()
    assert process.returncode == 1
    assert f"--offload needs containers: use it with --mode cloud, not --mode {mode}" in output.decode()
