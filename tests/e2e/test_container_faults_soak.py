"""Containers that are made and destroyed in a row leave nothing."""

from __future__ import annotations

import asyncio
import re
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.e2e]

ROOT = Path(__file__).parents[2]
COUNT = 20


async def test_a_short_soak() -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "benchmarks.soak", "--count", str(COUNT)),
        cwd=ROOT,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    output, _ = await process.communicate()
    text = output.decode()
    assert process.returncode == 0, text
    last = [line for line in text.splitlines() if line.startswith("{")][-1]
    assert f"'made': {COUNT}," in last
    assert set(re.findall(r"'(?:process|mount|cgroup|interface|file)': (\d+)", last)) == {"0"}
