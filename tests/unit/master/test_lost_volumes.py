"""Snapshots of volumes, and lost machines: what is restored elsewhere, and what is waited for."""

from __future__ import annotations

import pytest
from support.moving_volumes import KEPT, NEW, OLD, SIZE, Moving

from rce.control import EndpointState, EndpointStatus
from rce.model import MEGABYTE, Volume
from rce_master.exceptions import LimitReachedError
from rce_master.state import commands
from rce_master.state.lifecycle import VolumeMovePhase
from rce_master.state.settings import StateSettings


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


def test_its_user_is_not_told_to_wait_for_a_machine() -> None:
    world = Moving(KEPT)
    world.saved(is_last=False)
    lose(world)
    changes = world.tick(world.state.settings.placement_timeout + 1)
    assert world.phase_of_move() is VolumeMovePhase.RESTORING
    assert (changes.notices, changes.events, world.stays) == ([], [], "")


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
