"""The processor time and memory of a machine's programs, also of those that ended."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.machines import MachineLink, MachineNetwork
from rce_fleet.experiments.usage import (
    ControlGroup2,
    ControlGroups1,
    Meter,
    ProcessTable,
    make_meter,
    period_us,
)

BURN = """
import os, sys, time
cpu, size = float(sys.argv[1]), int(sys.argv[2])
kept = bytearray(os.urandom(size))
if os.fork() == 0:
    while time.process_time() < cpu:
        pass
    os._exit(0)
os.wait()
print("done", flush=True)
sys.stdin.read()
"""


@contextmanager
def meter() -> Iterator[Meter]:
    name = f"rcx-test-{os.getpid()}"
    for kind in (ControlGroups1, ControlGroup2):
        try:
            made = kind(name)
        except OSError:
            continue
        yield made
        made.close()
        return
    pytest.skip("control groups cannot be made here")


def burn(prefix: tuple[str, ...], cpu: float, size: int = 0) -> subprocess.Popen[str]:
    argv = [*prefix, sys.executable, "-c", BURN, str(cpu), str(size)]
    process = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "done\n"
    return process


@pytest.mark.needs("cgroups")
def test_control_groups_count_programs_that_ended() -> None:
    with meter() as counted:
        process = burn(counted.prefix, 0.5, 30_000_000)
        found = counted.read()
        assert 0.5 <= found.cpu_s < 1.5
        assert 30e6 < found.memory < 60e6
        process.communicate()
        assert counted.read().cpu_s >= found.cpu_s


@pytest.mark.needs("cgroups")
def test_a_limited_machine_gets_its_share() -> None:
    with meter() as counted:
        counted.limit(0.2)
        began = os.times().elapsed
        burn(counted.prefix, 0.4).communicate()
        assert os.times().elapsed - began >= 1.5
        counted.limit(0)


@pytest.mark.needs("netns")
async def test_the_process_table_counts_a_machines_processes() -> None:
    async with MachineNetwork({"robot": MachineLink()}) as network:
        machine = network.machines["robot"]
        counted = ProcessTable(machine.namespace)
        process = burn(machine.prefix, 0.3, 10_000_000)
        found = counted.read()
        assert found.cpu_s < 0.3, "the child's time is not its parent's"
        assert found.memory > 10e6
        process.communicate()
        assert counted.read().cpu_s == found.cpu_s
        with pytest.raises(ExperimentError, match="without control groups"):
            counted.limit(0.5)


def test_the_best_meter_is_chosen() -> None:
    name = f"rcx-choice-{os.getpid()}"
    made = make_meter(name, "none")
    try:
        assert made.limits or isinstance(made, ProcessTable)
    finally:
        made.close()


@pytest.mark.parametrize(("cores", "period"), [(0.0, 100_000), (0.01, 100_000), (0.2, 10_000), (1.0, 2_000)])
def test_a_limited_machine_stops_only_shortly(cores: float, period: int) -> None:
    """The kernel takes periods from 1 ms to 1 s, and shares of them from 1 ms on."""
    assert period_us(cores) == period
    assert not cores or cores * period_us(cores) >= 1000
