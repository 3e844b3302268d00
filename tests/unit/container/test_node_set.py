"""The nodes of a container, as far as no process is needed."""

from __future__ import annotations

import asyncio
import dataclasses
import threading
from pathlib import Path
from typing import NoReturn

import pytest

from rce.control.model import NodeState
from rce.model.specs import NodeSpec
from rce.ros.packages import PackageIndex
from rce_container.environment.exceptions import NodeError
from rce_container.environment.nodes import node_set
from rce_container.environment.nodes.node_life import NodeContext
from rce_container.environment.nodes.node_set import NodeSet
from rce_container.environment.nodes.reaper import Reaper
from rce_container.environment.user_packages import LaunchEnvironment


def context(folder: Path, faults: list[str]) -> NodeContext:
    def launch_environment(_: NodeSpec) -> NoReturn:
        raise NodeError("no package 'x'")

    async def why_killed() -> str:
        return ""

    async def keep_state(*_: object) -> None:
        """No node of these tests has a state."""

    return NodeContext(
        reaper=Reaper(),
        launch_environment=launch_environment,
        mark="mark",
        home=str(folder),
        logs=folder,
        interrupt_timeout=1.0,
        terminate_timeout=1.0,
        on_change=lambda: None,
        on_fault=faults.append,
        keep_state=keep_state,
        why_killed=why_killed,
    )


def spec(tag: str) -> NodeSpec:
    return NodeSpec(tag=tag, pkg="x", exe="y")


async def test_packages_of_a_node_are_looked_for_in_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The event loop, which carries the container's topics, does not wait for a large folder."""
    threads: list[bool] = []

    def look(_: PackageIndex) -> None:
        threads.append(threading.current_thread() is threading.main_thread())

    monkeypatch.setattr(PackageIndex, "look", look)
    index = PackageIndex([tmp_path / "workspace"])
    faults: list[str] = []
    found_by_index = dataclasses.replace(
        context(tmp_path, faults), launch_environment=lambda node: LaunchEnvironment(node, index, {})
    )
    async with asyncio.TaskGroup() as tasks:
        found = NodeSet(found_by_index, tasks)
        found.apply([spec("a")])
        while found.statuses[0].state is not NodeState.FAILED:
            await asyncio.sleep(0)
        await found.close()
    assert threads == [False]
    assert "no package 'x' on the package path" in faults[0]


async def test_what_cannot_be_started_is_told_and_noted(tmp_path: Path) -> None:
    faults: list[str] = []
    async with asyncio.TaskGroup() as tasks:
        found = NodeSet(context(tmp_path, faults), tasks)
        found.apply([spec("a")])
        while found.statuses[0].state is not NodeState.FAILED:
            await asyncio.sleep(0)
        assert found.is_degraded
        assert not found.is_settling
        await found.close()
    assert faults == ["node a cannot be started: no package 'x'"]
    text = (tmp_path / "a.000000000000.log").read_text()
    assert text == "x-- cannot be started: no package 'x' --\n"


async def test_logs_of_nodes_that_are_gone_do_not_pile_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_set, "MAX_DEPARTED", 3)
    async with asyncio.TaskGroup() as tasks:
        found = NodeSet(context(tmp_path, []), tasks)
        for tag in ("a", "stays", "b", "a", "c", "d"):
            found.apply([spec("stays"), spec(tag)] if tag != "stays" else [spec("stays")])
            while any(status.state is NodeState.STARTING for status in found.statuses):
                await asyncio.sleep(0)
        found.apply([spec("stays")])
        assert sorted(path.name[0] for path in tmp_path.iterdir()) == ["a", "c", "d", "s"]
        await found.close()


async def test_a_log_that_cannot_be_opened_is_a_fault_of_its_node(tmp_path: Path) -> None:
    faults: list[str] = []
    (tmp_path / "a.000000000000.log").mkdir()
    async with asyncio.TaskGroup() as tasks:
        found = NodeSet(context(tmp_path, faults), tasks)
        found.apply([spec("a")])
        while found.statuses[0].state is not NodeState.FAILED:
            await asyncio.sleep(0)
        await found.close()
    assert faults == ["node a cannot be started: its log cannot be opened: Is a directory"]
