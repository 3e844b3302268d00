"""What limits follow from what a container asks for, and what is said when they strike."""

from __future__ import annotations

import asyncio
import resource
from types import MappingProxyType

import pytest

from rce.model.specs import Resources
from rce_container.exceptions import LimitError
from rce_container.limits import ControlGroup, ControlGroupUsage, Limits, RlimitLimiter, limits_of
from rce_container.limits.base import Troubles, in_megabytes
from rce_container.limits.cgroup1 import parse_io
from rce_container.limits.enforcer import LimitEnforcer
from rce_container.settings import ContainerSettings

MB = 1 << 20
SETTINGS = ContainerSettings(machine="m", slot_memory=100 * MB, slot_processes=50)


@pytest.mark.parametrize(
    ("resources", "limits"),
    [
        (Resources(), Limits(0.0, 100 * MB, 50, 100)),
        (Resources(size=0), Limits(0.0, 100 * MB, 50, 100)),
        (Resources(size=3), Limits(0.0, 300 * MB, 150, 300)),
        (Resources(size=3, memory=64 * MB, cpu=0.5), Limits(0.5, 64 * MB, 150, 300)),
    ],
)
def test_limits_are_what_is_asked_for_else_the_slots(resources: Resources, limits: Limits) -> None:
    assert limits_of(resources, SETTINGS) == limits


def test_megabytes_are_rounded_up() -> None:
    assert [in_megabytes(size) for size in (64 * MB, 64 * MB + 1, 1)] == ["64 MB", "65 MB", "1 MB"]


def test_io_is_summed_over_disks() -> None:
    text = "8:0 Read 100\n8:0 Write 20\n8:0 Total 120\n259:0 Read 1\n259:0 Write 2\nTotal 123\n"
    assert parse_io(text) == {"Read": 101, "Write": 22, "Total": 120}
    assert parse_io("Total 0\n8:0 Read max\n") == {}


def test_without_cgroups_each_process_limits_itself() -> None:
    control_group = RlimitLimiter("no cgroups").create("m", Limits(1.0, 64 * MB, 32, 100))
    assert control_group.rlimits == {resource.RLIMIT_DATA: 64 * MB, resource.RLIMIT_NPROC: 32}
    assert (control_group.join, control_group.usage()) == ((), ControlGroupUsage())
    control_group.apply(Limits(1.0, 64 * MB, 32, 100))
    with pytest.raises(LimitError, match="destroy it and create it again"):
        control_group.apply(Limits(1.0, 65 * MB, 32, 100))
    assert control_group.limits.memory == 64 * MB


def test_adopted_container_gets_desired_limits_sans_cgroup() -> None:
    """An adopted container without cgroups has the limits that are desired."""
    control_group = RlimitLimiter().adopt("m")
    control_group.apply(Limits(0.0, 64 * MB, 32, 100))
    assert control_group.limits.memory == 64 * MB


class PaperCell(ControlGroup):
    """A cell on which a test plays."""

    join = ()
    rlimits = MappingProxyType[int, int]({})

    def __init__(self) -> None:
        self.limits = Limits(memory=64 * MB, processes=50)
        self.struck = Troubles()
        self.peak = 64 * MB
        self.refusal = ""

    def apply(self, limits: Limits) -> None:
        if self.refusal:
            raise LimitError(self.refusal)
        self.limits = limits

    def usage(self) -> ControlGroupUsage:
        return ControlGroupUsage(memory_peak=self.peak)

    def troubles(self) -> Troubles:
        return self.struck

    def pids(self) -> list[int]:
        return []

    def kill(self) -> None: ...

    def remove(self) -> None: ...


@pytest.fixture
def control_group() -> PaperCell:
    return PaperCell()


OUT_OF_MEMORY = (
    "out of memory: the container's limit of 64 MB; ask for more with `rce resize box --memory 128M`"
)


def test_a_kill_is_claimed_once(control_group: PaperCell) -> None:
    enforcer = LimitEnforcer("box", control_group, SETTINGS)
    assert enforcer.claim() == ""
    control_group.struck = Troubles(oom_kills=2)
    assert [enforcer.claim() for _ in range(3)] == [OUT_OF_MEMORY, OUT_OF_MEMORY, ""]
    assert [enforcer.review() for _ in range(3)] == [[], [], []]


def test_kills_before_an_adoption_are_nobodys(control_group: PaperCell) -> None:
    control_group.struck = Troubles(oom_kills=2)
    assert LimitEnforcer("box", control_group, SETTINGS).claim() == ""


def test_a_kill_that_nobody_claims_is_told_after_a_while(control_group: PaperCell) -> None:
    enforcer = LimitEnforcer("box", control_group, SETTINGS)
    control_group.struck = Troubles(oom_kills=1)
    assert enforcer.review() == [], "the node's end may be reported yet"
    assert enforcer.review() == [f"a process that a node started was killed: {OUT_OF_MEMORY}"]
    assert enforcer.review() == []
    assert enforcer.claim() == ""


def test_a_claim_in_the_meantime_is_not_told_twice(control_group: PaperCell) -> None:
    enforcer = LimitEnforcer("box", control_group, SETTINGS)
    control_group.struck = Troubles(oom_kills=1)
    enforcer.review()
    assert enforcer.claim() == OUT_OF_MEMORY
    assert enforcer.review() == []


def test_memory_of_machine_and_container_differ(control_group: PaperCell) -> None:
    """Memory of the machine is told from that of the container."""
    control_group.peak = 10 * MB
    enforcer = LimitEnforcer("box", control_group, SETTINGS)
    control_group.struck = Troubles(oom_kills=3)
    assert enforcer.claim_all() == "out of memory: its machine has no more"
    assert enforcer.claim() == ""


def test_refused_processes_are_told_once_for_each_spell(control_group: PaperCell) -> None:
    enforcer = LimitEnforcer("box", control_group, SETTINGS)
    texts = []
    for count in (0, 5, 9, 9, 10):
        control_group.struck = Troubles(refused_forks=count)
        texts.append(enforcer.review())
    text = (
        "its limit of 50 processes and threads is reached, so it cannot start more; "
        "ask for more slots with `rce resize box --size 2`"
    )
    assert texts == [[], [text], [], [], [text]]


async def test_limits_that_cannot_be_are_told_once(control_group: PaperCell) -> None:
    enforcer = LimitEnforcer("box", control_group, SETTINGS)
    control_group.refusal = "it is too full"
    assert await enforcer.apply(Resources()) == "it is too full; the limits stay as they were"
    assert await enforcer.apply(Resources()) == ""
    assert control_group.limits.memory == 64 * MB
    control_group.refusal = ""
    assert await enforcer.apply(Resources()) == ""
    assert control_group.limits == limits_of(Resources(), SETTINGS)


async def test_the_newest_limits_win(control_group: PaperCell) -> None:
    enforcer = LimitEnforcer("box", control_group, SETTINGS)
    async with asyncio.TaskGroup() as tasks:
        for size in (1, 2, 3):
            tasks.create_task(enforcer.apply(Resources(size=size)))
    assert control_group.limits.memory == 300 * MB
