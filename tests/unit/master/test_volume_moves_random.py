"""Machines and masters that end and come back at random while a container with a volume moves."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.moving_volumes import JOURNAL, KEPT, Moving

from rce.control import RestoreVolume, SaveVolume
from rce_master.state import commands
from rce_master.state.changes import Changes
from rce_master.state.lifecycle import VolumeMovePhase

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


@pytest.mark.slow
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
