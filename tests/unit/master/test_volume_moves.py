"""Containers with volumes that move: each phase, and each fault in each phase."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from support.master_world import World
from support.moving_volumes import JOURNAL, NEW, OLD, SIZE, Moving

from rce.control import SNAPSHOTS, EndpointState, EndpointStatus, RestoreVolume, SaveVolume
from rce.control.messages import CONTROL_VERSION, Hello, MachineInfo, TaskSetKind, VolumeSaved
from rce.model import Network
from rce.model.specs import ResourceChanges, Resources
from rce_master.exceptions import ConflictError, NoRoomError
from rce_master.packages.contents import ContentStore
from rce_master.snapshots.service import SnapshotService
from rce_master.state import commands
from rce_master.state.lifecycle import VolumeMovePhase
from rce_master.state.volume_moves import phase_began

if TYPE_CHECKING:
    from pathlib import Path

    from support.master_cloud import Cloud

PHASES = [VolumeMovePhase.STOPPING, VolumeMovePhase.SAVING, VolumeMovePhase.RESTORING]


def test_a_container_moves_with_its_volume() -> None:
    world = Moving()
    changes = world.move()
    (drop,) = changes.withdrawals
    assert (drop.process, drop.id) == ("c1", "anna/c")
    assert drop.elsewhere, "states are saved before its end"
    assert not world.runs_at("c1")
    assert (world.orders("c1"), world.orders("c2")) == ([], [])
    world.gone()
    assert world.orders("c1") == [SaveVolume(volume="anna/journal", placement=1)]
    world.saved()
    assert world.orders("c1") == []
    assert world.orders("c2") == [RestoreVolume(volume="anna/journal", placement=2, snapshot=NEW, size=SIZE)]
    assert not world.runs_at("c2")
    world.restored()
    assert world.runs_at("c2")
    assert [(one.number, one.is_new) for one in world.spec("c").volumes] == [(2, False)]
    assert world.removals() == set(), "the former folder stays until the container is up"
    assert world.volume.former == ("c1",)
    world.run("c", "c2")
    assert world.removals() == {"c1"}
    volume = world.volume
    assert (volume.process, volume.former, volume.snapshot) == ("c2", (), "")


def test_drain_moves_it_and_returns_when_it_is_told() -> None:
    world = Moving()
    world.do(commands.SetDraining(machine="c1", draining=True))
    world.gone()
    world.saved()
    world.restored()
    assert world.runs_at("c2")
    world.run("c", "c2")
    world.do(commands.VolumeRemoved(process="c1", volume="anna/journal"))
    world.do(commands.SetDraining(machine="c1", draining=False))
    world.move("m1")
    world.gone("c2")
    world.saved()
    world.restored("c1")
    assert world.runs_at("c1")
    assert world.volume.placement == 3


@pytest.mark.parametrize("phase", PHASES)
def test_a_new_master_continues_in_each_phase(phase: VolumeMovePhase) -> None:
    world = Moving()
    world.up_to(phase)
    world.restart_master()
    assert world.phase_of_move() is phase
    still = EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING)
    world.machine("c2")
    world.machine("c1", *([still] if phase is VolumeMovePhase.STOPPING else []))
    assert not world.runs_at("c1")
    if phase is VolumeMovePhase.STOPPING:
        world.gone()
    if world.phase_of_move() is VolumeMovePhase.SAVING:
        assert len(world.orders("c1")) == 1
        world.saved()
    assert len(world.orders("c2")) == 1
    world.restored()
    assert world.runs_at("c2")


def test_a_master_that_missed_the_end_continues() -> None:
    world = Moving()
    world.move()
    world.leave("c1")
    world.machine("c1")
    assert world.phase_of_move() is VolumeMovePhase.SAVING


@pytest.mark.parametrize("phase", PHASES)
def test_a_target_that_goes_lets_it_run_where_it_was(phase: VolumeMovePhase) -> None:
    world = Moving()
    world.up_to(phase)
    world.leave("c2")
    assert world.runs_at("c1")
    assert "c2: it went away" in world.stays
    assert [(one.number, one.is_new) for one in world.spec("c").volumes] == [(1, True)]
    assert world.removals() == ({"c2"} if phase is VolumeMovePhase.RESTORING else set())


@pytest.mark.parametrize("phase", PHASES)
def test_a_phase_that_takes_too_long_ends_the_move(phase: VolumeMovePhase) -> None:
    world = Moving()
    world.up_to(phase)
    world.tick(world.state.settings.volume_move_timeout + 1)
    assert world.runs_at("c1")
    assert "for more than 1800 s" in world.stays


@pytest.mark.parametrize("phase", PHASES)
def test_it_can_be_destroyed_in_each_phase(phase: VolumeMovePhase) -> None:
    world = Moving()
    world.up_to(phase)
    world.do(commands.DestroyContainer(user="anna", tag="c"))
    assert world.volume.process == "c1"
    assert world.removals() == ({"c2"} if phase is VolumeMovePhase.RESTORING else set())


@pytest.mark.parametrize("phase", PHASES)
def test_a_second_move_is_refused(phase: VolumeMovePhase) -> None:
    world = Moving()
    world.machine("c3")
    world.up_to(phase)
    with pytest.raises(ConflictError, match="moves to c2 already"):
        world.move("m3")


def test_a_failure_to_save_or_restore_lets_it_run_where_it_was() -> None:
    world = Moving()
    world.up_to(VolumeMovePhase.SAVING)
    world.saved(error="the master's disk is full")
    assert world.runs_at("c1")
    assert "volume 'journal' could not be saved: the master's disk is full" in world.stays
    world.move()
    world.gone()
    world.saved()
    world.restored(error="a wrong hash")
    assert world.runs_at("c1")
    assert world.removals() == {"c2"}
    assert world.volume.placement == 1


def test_answers_of_others_count_for_nothing() -> None:
    world = Moving()
    world.up_to(VolumeMovePhase.SAVING)
    world.saved(process="c2")
    world.saved(OLD, is_last=False)
    assert world.phase_of_move() is VolumeMovePhase.SAVING
    world.saved()
    for process, number in (("c1", 2), ("c2", 1), ("c2", 3)):
        world.do(commands.VolumeRestored(process=process, volume="anna/journal", placement=number))
    assert world.phase_of_move() is VolumeMovePhase.RESTORING
    world.saved(OLD)
    assert world.volume.snapshot == NEW


FAILED = EndpointStatus(id="anna/c", revision=1, state=EndpointState.FAILED, detail="no such package")


@pytest.mark.parametrize("error", ["", "the master's disk is full"])
def test_a_late_answer_to_an_earlier_move_counts_for_nothing(error: str) -> None:
    """Its files lack what the container has written since."""
    world = Moving()
    world.do(commands.SetDraining(machine="m1", draining=True))
    world.gone()
    earlier = phase_began(world.state.tables, "anna/journal")
    world.do(commands.SetDraining(machine="m1", draining=False))
    world.run("c", "c1")
    world.tick(1)
    world.do(commands.SetDraining(machine="m1", draining=True))
    world.gone()
    world.saved(OLD, error=error, since=earlier)
    assert world.phase_of_move() is VolumeMovePhase.SAVING
    world.saved()
    assert world.orders("c2") == [RestoreVolume(volume="anna/journal", placement=2, snapshot=NEW, size=SIZE)]


async def test_an_answer_belongs_to_the_move_that_it_found(cloud: Cloud, tmp_path: Path) -> None:
    """The same, while the master is busy with the answer."""
    state_service = cloud.state_service

    async def do(*wanted: commands.Command) -> None:
        assert not any(await state_service.submit_all(list(wanted)))

    def phase() -> VolumeMovePhase | None:
        move = state_service.tables.volume_moves.get("anna/c")
        return None if move is None else move.phase

    for number in (1, 2):
        machine = MachineInfo(name=f"m{number}", slots=4, volumes="image")
        hello = Hello(
            version=CONTROL_VERSION,
            kind=TaskSetKind.CONTAINER,
            process=f"c{number}",
            machine=machine,
            features=(SNAPSHOTS,),
        )
        await cloud.control_handler.on_hello(cloud.containers(hello.process), hello)
        if number == 1:
            await do(commands.CreateContainer(user="anna", tag="c", resources=Resources(volumes=(JOURNAL,))))
    drain, undo = (commands.SetDraining(machine="m1", draining=wanted) for wanted in (True, False))
    gone = commands.EndpointGone(process="c1", id="anna/c")
    service = SnapshotService(state_service, ContentStore(tmp_path))
    answer = VolumeSaved(volume="anna/journal", placement=1, is_last=True, error="the disk is full")
    await do(drain, gone)
    late = service.accept("c1", answer)
    await do(undo)
    await do(drain, gone)
    assert phase() is VolumeMovePhase.SAVING
    await late
    assert phase() is VolumeMovePhase.SAVING
    await service.accept("c1", answer)
    assert phase() is None


def returned() -> Moving:
    """A container that failed at ``c2``, and was brought back to ``c1``."""
    world = Moving()
    world.up_to(VolumeMovePhase.RESTORING)
    world.restored()
    world.report("c2", FAILED)
    assert world.phase_of_move() is VolumeMovePhase.STOPPING
    world.gone("c2")
    assert world.orders("c2") == [SaveVolume(volume="anna/journal", placement=2)]
    world.saved()
    world.restored("c1")
    assert world.runs_at("c1")
    return world


@pytest.mark.parametrize("phase", PHASES)
def test_it_grows_only_if_the_next_machine_has_room(phase: VolumeMovePhase) -> None:
    world = Moving()
    world.up_to(phase)
    world.do(commands.SetDraining(machine="m1", draining=True))
    world.container("d", size=3)
    assert world.state.tables.endpoints["anna/d"].task_set == "c2"
    with pytest.raises(NoRoomError, match="m2 has 1 of 4 slots free, 2 needed"):
        world.do(commands.ResizeContainer(user="anna", tag="c", changes=ResourceChanges(size=2)))


def test_it_goes_back_if_it_fails_at_the_new_machine() -> None:
    world = returned()
    world.run("c", "c1")
    assert (world.removals(), world.volume.placement) == ({"c2"}, 3)


def test_it_stays_if_it_fails_after_its_return_too() -> None:
    """Else it would move between two machines without end."""
    world = returned()
    world.restart_master()
    world.machine("c1", FAILED)
    world.machine("c2")
    world.report("c1", FAILED)
    assert world.phase_of_move() is None
    assert world.runs_at("c1")
    assert world.stays == "it failed at c2, and after its return here, too: no such package"
    assert world.report("c1", FAILED).events == [], "that is told once"
    world.run("c", "c1")
    assert world.removals() == {"c2"}
    world.do(commands.VolumeRemoved(process="c2", volume="anna/journal"))
    world.up_to(VolumeMovePhase.RESTORING)
    world.restored()
    world.report("c2", FAILED)
    assert world.phase_of_move() is VolumeMovePhase.STOPPING, "it was up meanwhile: it may return again"


def test_a_drain_rests_after_a_return() -> None:
    world = returned()
    world.do(commands.SetDraining(machine="m1", draining=True))
    world.report("c1", FAILED)
    assert world.phase_of_move() is None
    world.tick(world.state.settings.move_rest + 1)
    assert world.phase_of_move() is VolumeMovePhase.STOPPING


def test_files_are_removed_only_when_it_is_up() -> None:
    world = Moving()
    world.up_to(VolumeMovePhase.RESTORING)
    world.restored()
    world.leave("c1")
    for state in (EndpointState.STARTING, EndpointState.FAILED):
        world.report("c2", EndpointStatus(id="anna/c", revision=1, state=state))
        assert world.removals() == set()
    world.run("c", "c2")
    assert world.removals() == {"c1"}


def test_volumes_of_a_group_and_of_older_machines_stay() -> None:
    world = World()
    for process in ("c1", "c2"):
        world.container_set(
            process, name=process, slots=9, volumes="image", networks=("none", "group"), features=(SNAPSHOTS,)
        )
    world.container("c", volumes=(JOURNAL,), network=Network.GROUP, group="g")
    world.container("d", network=Network.GROUP, group="g")
    with pytest.raises(NoRoomError, match="in the network of a group"):
        world.do(commands.MoveContainer(user="anna", tag="c", machine="c2"))
    older = Moving()
    older.machine("c2", snapshots=False)
    with pytest.raises(NoRoomError, match="runs an earlier release"):
        older.move()


def test_it_stays_with_a_container_that_joins_its_group_meanwhile() -> None:
    world = Moving(group="g")
    world.up_to(VolumeMovePhase.RESTORING)
    world.container("d", network=Network.GROUP, group="g")
    assert world.state.tables.endpoints["anna/d"].task_set == "c1"
    world.restored()
    assert world.runs_at("c1")
    assert "a container joined its group meanwhile" in world.stays
    assert world.removals() == {"c2"}
