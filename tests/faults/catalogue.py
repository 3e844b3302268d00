"""The scenarios."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from faults.scenarios import backup, disk, etcd, kill, network
from faults.world import World


@dataclass(frozen=True, slots=True)
class Scenario:
    """A kind of fault.

    Attributes:
        robot: Whether task sets and a robot run meanwhile.
        short: Whether it belongs to the short form, which all tests contain.
    """

    name: str
    run: Callable[[World], Awaitable[None]]
    robot: bool = True
    short: bool = False


SCENARIOS = (
    Scenario("kill", kill.kill, short=True),
    Scenario("stop", kill.stop, short=True),
    Scenario("stop-idle", kill.stop_idle),
    Scenario("stop-etcd", kill.stop_etcd),
    Scenario("terminate", kill.terminate, short=True),
    Scenario("drain", kill.drain),
    Scenario("cut", network.cut),
    Scenario("cut-pairs", network.cut_pairs),
    Scenario("cut-from-task-sets", network.cut_from_task_sets),
    Scenario("cut-etcd-apart", network.cut_etcd_apart, short=True),
    Scenario("flap", network.flap),
    Scenario("lost-answers", network.lose_answers),
    Scenario("delay", network.delay, robot=False),
    Scenario("away", etcd.away),
    Scenario("clocks", etcd.clocks),
    Scenario("clock-jumps", etcd.clock_jumps),
    Scenario("slow-disk", etcd.slow_disk, robot=False),
    Scenario("full-disk", etcd.full_disk),
    Scenario("slow-master-disk", disk.slow_disk, robot=False),
    Scenario("full-master-disk", disk.full_disk, robot=False),
    Scenario("full-database", etcd.full_database, short=True),
    Scenario("replace-member", etcd.replace_member),
    Scenario("upgrade", kill.upgrade),
    Scenario("restore", backup.restore),
)
