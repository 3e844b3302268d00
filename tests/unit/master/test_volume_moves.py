"""Containers with volumes that move: each phase, each fault in each phase, and lost machines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.master_world import World

from rce.control import SNAPSHOTS, EndpointState, EndpointStatus, RestoreVolume, SaveVolume
from rce.model import MEGABYTE, Network, Volume
from rce.model.specs import ResourceChanges
from rce_master.exceptions import ConflictError, LimitReachedError, NoRoomError
from rce_master.state import commands
from rce_master.state.changes import Changes
from rce_master.state.core import State
from rce_master.state.lifecycle import VolumeMovePhase
from rce_master.state.records import UserVolume
from rce_master.state.settings import StateSettings

SIZE = 64 * MEGABYTE
JOURNAL = Volume(name="journal", path="/data", size=SIZE)
KEPT = Volume(name="journal", path="/data", size=SIZE, snapshots=60)
OLD, NEW = "a" * 64, "b" * 64


class Moving(World):
    """Two machines or more; container ``c`` with a volume runs at ``c1``."""

    def __init__(
        self, volume: Volume = JOURNAL, options: StateSettings | None = None, *, group: str = ""
    ) -> None:
        super().__init__(options)
        self.machine("c1")
        network = Network.GROUP if group else Network.NONE
        self.container("c", volumes=(volume,), network=network, group=group)
        self.run("c", "c1")
        self.machine("c2")

    def machine(self, process: str, *running: EndpointStatus, snapshots: bool = True) -> None:
        self.container_set(
            process,
            running,
            name=f"m{process[1:]}",
            slots=4,
            volumes="image",
            networks=("none", "group"),
            features=(SNAPSHOTS,) if snapshots else (),
        )

    @property
    def volume(self) -> UserVolume:
        return self.state.tables.volumes["anna/journal"]

    @property
    def place(self) -> str:
        return self.state.tables.endpoints["anna/c"].task_set

    def phase_of_move(self) -> VolumeMovePhase | None:
        move = self.state.tables.volume_moves.get("anna/c")
        return None if move is None else move.phase

    @property
    def stays(self) -> str:
        return self.state.tables.container_live("anna/c").stays

    def orders(self, process: str) -> list[Any]:
        return self.state.orders(process)

    def move(self, machine: str = "m2") -> Any:
        return self.do(commands.MoveContainer(user="anna", tag="c", machine=machine))

    def gone(self, process: str = "c1") -> None:
        self.do(commands.EndpointGone(process=process, id="anna/c"))

    def saved(self, snapshot: str = NEW, *, error: str = "", is_last: bool = True, process: str = "") -> None:
        command = commands.SnapshotTaken(
            process=process or self.volume.process,
            volume="anna/journal",
            placement=self.volume.placement,
            is_last=is_last,
            snapshot="" if error else snapshot,
            size=7,
            taken=5.0,
            error=error,
        )
        self.do(command)

    def restored(self, process: str = "c2", *, error: str = "") -> None:
        number = self.volume.placement + 1
        self.do(
            commands.VolumeRestored(process=process, volume="anna/journal", placement=number, error=error)
        )

    def up_to(self, phase: VolumeMovePhase) -> None:
        """Bring the move of a container to a phase."""
        self.move()
        if phase is not VolumeMovePhase.STOPPING:
            self.gone()
        if phase is VolumeMovePhase.RESTORING:
            self.saved()
        assert self.phase_of_move() is phase

    def restart_master(self) -> None:
        tables = [table for table in self.state.tables.all if table.persistent]
        rows = {table.name: {table.key(record): table.encode(record) for record in table} for table in tables}
        self.state = State.load(rows, self.now, self.state.settings)
        self.state.validate()

    def removals(self) -> set[str]:
        return {removal.process for removal in self.state.tables.volume_removals}

    def runs_at(self, process: str) -> bool:
        """Whether a task set is told to run the container."""
        return self.place == process and not self.state.is_held("anna/c")


PHASES = [VolumeMovePhase.STOPPING, VolumeMovePhase.SAVING, VolumeMovePhase.RESTORING]


def test_a_container_moves_with_its_volume() -> None:
    world = Moving()
    changes = world.move()
    assert [(one.process, one.id) for one in changes.withdrawals] == [("c1", "anna/c")]
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


# Lost machines


def lose(world: Moving, process: str = "c1") -> None:
    world.leave(process)
    world.tick(world.state.settings.container_grace + 1)


def test_a_lost_machine_without_a_snapshot_is_waited_for() -> None:
    world = Moving()
    lose(world)
    world.tick(world.state.settings.placement_timeout + 1)
    assert world.place == ""
    assert "there is no snapshot of journal, so start that machine again" in world.stays
    world.machine("c1")
    assert world.runs_at("c1")


def test_the_last_snapshot_is_restored_elsewhere() -> None:
    world = Moving(KEPT)
    world.saved(OLD, is_last=False)
    world.saved(NEW, is_last=False)
    lose(world)
    assert world.phase_of_move() is VolumeMovePhase.RESTORING
    assert [one.snapshot for one in world.orders("c2")] == [NEW]
    world.restored()
    assert world.runs_at("c2")
    world.run("c", "c2")
    assert world.volume.snapshot == NEW, "it was asked for"
    assert world.removals() == {"c1"}
    still = EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING)
    world.machine("c1", still)
    assert world.runs_at("c2")


def test_a_machine_that_comes_back_before_the_end_has_the_newest_files() -> None:
    world = Moving(KEPT)
    world.saved(is_last=False)
    lose(world)
    assert world.phase_of_move() is VolumeMovePhase.RESTORING
    world.machine("c1")
    assert world.runs_at("c1")
    assert world.removals() == {"c2"}
    again = Moving(KEPT)
    again.saved(is_last=False)
    lose(again)
    again.machine("c1", EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING))
    assert again.runs_at("c1")


def test_a_lost_source_of_a_move() -> None:
    world = Moving()
    world.up_to(VolumeMovePhase.RESTORING)
    lose(world)
    assert (world.place, world.phase_of_move()) == ("", VolumeMovePhase.RESTORING)
    world.restored()
    assert world.runs_at("c2"), "what was saved is restored"
    early = Moving(KEPT)
    early.saved(OLD, is_last=False)
    early.up_to(VolumeMovePhase.SAVING)
    lose(early)
    assert [one.snapshot for one in early.orders("c2")] == [OLD], "the last snapshot before the move"


def test_a_restore_that_fails_is_tried_again() -> None:
    world = Moving(KEPT)
    world.saved(is_last=False)
    lose(world)
    world.restored(error="the disk is full")
    assert world.phase_of_move() is VolumeMovePhase.RESTING
    world.do(commands.VolumeRemoved(process="c2", volume="anna/journal"))
    world.tick(world.state.settings.move_rest + 1)
    assert world.phase_of_move() is VolumeMovePhase.RESTORING
    world.restored()
    assert world.runs_at("c2")


def test_both_machines_lost_one_after_the_other() -> None:
    world = Moving(KEPT)
    world.saved(is_last=False)
    lose(world)
    world.restored()
    world.machine("c3")
    lose(world, "c2")
    world.restored("c3")
    assert world.runs_at("c3")
    assert (world.volume.former, world.volume.placement) == (("c1", "c2"), 3)
    world.run("c", "c3")
    assert world.removals() == {"c1", "c2"}


def test_a_volume_without_a_container_is_restored_for_the_next_one() -> None:
    world = Moving(KEPT)
    world.saved(is_last=False)
    world.do(commands.DestroyContainer(user="anna", tag="c"))
    world.gone()
    lose(world)
    world.container("c", volumes=(KEPT,))
    assert world.phase_of_move() is VolumeMovePhase.RESTORING
    world.restored()
    assert world.runs_at("c2")


def test_snapshots_count_as_disk_and_their_faults_are_told() -> None:
    world = Moving(KEPT, StateSettings(max_package_size=150 * MEGABYTE))
    with pytest.raises(LimitReachedError, match="would take 192 MB of disk, and you may have 150 MB"):
        world.container("d", volumes=(Volume(name="other", path="/x", size=SIZE),))
    world.saved(error="the master's disk is full", is_last=False)
    assert world.volume.fault == "the master's disk is full"
    world.saved(is_last=False)
    assert (world.volume.fault, world.volume.kept, world.volume.taken) == ("", 7, 5.0)


def test_a_snapshot_that_no_master_holds_is_forgotten() -> None:
    world = Moving(KEPT)
    world.saved(is_last=False)
    world.do(commands.SnapshotLost(volume="anna/journal", snapshot=OLD))
    assert world.volume.snapshot == NEW
    world.do(commands.SnapshotLost(volume="anna/journal", snapshot=NEW))
    assert world.volume.snapshot == ""


STEPS = st.lists(
    st.sampled_from(
        [
            "master",
            "gone",
            "saved",
            "restored",
            "run",
            "leave c1",
            "leave c2",
            "come c1",
            "come c2",
            "wait",
            "long",
        ]
    ),
    max_size=40,
)


@given(STEPS, st.booleans())
@settings(max_examples=150, deadline=None)
def test_kills_in_any_phase_lose_and_run_nothing_twice(steps: list[str], kept: bool) -> None:
    """Machines and masters end and come back at any time; in the end the container runs at one of them.

    ``files`` stands for what is on the disks: the newest snapshot or folder that the container may have.
    """
    world = Moving(KEPT if kept else JOURNAL)
    files = {"c1": 1}
    world.move()
    for step in steps:
        _play(world, step, files)
        holders = [process for process in ("c1", "c2") if world.runs_at(process)]
        assert len(holders) <= 1
        for process in holders:
            assert files.get(process) == world.volume.placement, "it runs with older files"
    for process in ("c1", "c2"):
        world.machine(process)
    for _ in range(12):
        for step in ("gone", "saved", "removed", "restored", "run", "long"):
            _play(world, step, files)
    assert world.runs_at("c1") or world.runs_at("c2")
    assert world.phase_of_move() is None
    assert files == {world.place: world.volume.placement}, "folders that count no more are left"


def _play(world: Moving, step: str, files: dict[str, int]) -> None:
    name, _, process = step.partition(" ")
    actions: dict[str, Callable[[], None]] = {
        "master": world.restart_master,
        "leave": lambda: _forget(world.leave(process)),
        "come": lambda: world.machine(process),
        "wait": lambda: _forget(world.tick(5)),
        "long": lambda: _forget(world.tick(40)),
        "removed": lambda: _remove(world, files),
        "gone": lambda: _end(world),
        "saved": lambda: _save(world, files),
        "restored": lambda: _restore(world, files),
        "run": lambda: _run(world),
    }
    actions[name]()


def _forget(_: Changes) -> None:
    return


def _connected(world: Moving, *processes: str) -> list[str]:
    return [process for process in processes if world.state.tables.is_connected(process)]


def _remove(world: Moving, files: dict[str, int]) -> None:
    for removal in list(world.state.tables.volume_removals):
        for process in _connected(world, removal.process):
            files.pop(process, None)
            world.do(commands.VolumeRemoved(process=process, volume=removal.volume))


def _end(world: Moving) -> None:
    if world.phase_of_move() is VolumeMovePhase.STOPPING:
        for process in _connected(world, world.place):
            world.gone(process)


def _save(world: Moving, files: dict[str, int]) -> None:
    for process in _connected(world, "c1", "c2"):
        for order in world.orders(process):
            if isinstance(order, SaveVolume):
                assert files.get(process) == order.placement, "it saves older files"
                world.saved()


def _restore(world: Moving, files: dict[str, int]) -> None:
    for process in _connected(world, "c1", "c2"):
        for order in world.orders(process):
            if isinstance(order, RestoreVolume):
                files[process] = order.placement
                world.restored(process)


def _run(world: Moving) -> None:
    for process in _connected(world, world.place):
        if world.runs_at(process):
            world.run("c", process)
