"""Node programs that share a process: each takes a command line and variables of its own."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from rce.ros.launch.exceptions import Place
from rce.ros.launch.plan import NodePlan
from rce.ros.launching import StopTimeouts
from rce.ros.launching.command import NodeCommand, node_command
from rce.ros.launching.hosted import HostedNode, can_host
from rce.ros.launching.launched import describe_end
from rce.ros.node import Node
from rce.ros.node.hosting import HostedProgram, program_arguments, program_environ
from rce.ros.node.running import stop_signals
from rce.ros.packages import PackageIndex

URI = "http://127.0.0.1:1/"


def plan(**more: object) -> NodePlan:
    return NodePlan("/robot/tool", "shop", "tool", Place("main.launch", 1), **more)  # type: ignore[arg-type]


def command(module: str, *words: str) -> NodeCommand:
    return NodeCommand([], {"ROS_MASTER_URI": URI}, Path(), "", module, words)


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module with a node's ``main``: does as its first argument says."""
    (tmp_path / "hosted_tool.py").write_text(
        "import asyncio\n"
        "from rce.ros.node.hosting import program_arguments\n"
        "runs = []\n"
        "async def main():\n"
        "    word, *_ = program_arguments()\n"
        "    runs.append(word)\n"
        "    if word == 'wait': await asyncio.Event().wait()\n"
        "    if word == 'fail': raise ValueError(word)\n"
        "    if word == 'exit': raise SystemExit(3)\n"
        "    if word == 'say': raise SystemExit('no map')\n"
        "    if word == 'lose':\n"
        "        work = asyncio.create_task(asyncio.sleep(3600))\n"
        "        work.cancel()\n"
        "        await work\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "hosted_tool", raising=False)
    return "hosted_tool"


async def test_program_has_its_own_arguments_and_variables() -> None:
    async def main() -> tuple[list[str], str]:
        await asyncio.sleep(0)
        return list(program_arguments()), program_environ()["ROS_NAMESPACE"]

    programs = [HostedProgram([f"a:=b{n}"], {"ROS_NAMESPACE": f"robot{n}"}) for n in (1, 2)]
    found = await asyncio.gather(*(program.start(main()) for program in programs))
    assert found == [(["a:=b1"], "robot1"), (["a:=b2"], "robot2")]
    assert list(program_arguments()) == sys.argv[1:]
    assert program_environ() is os.environ


async def test_node_of_a_program_takes_its_names_and_stops_with_it() -> None:
    async def main() -> Node:
        return Node("tool")

    argv = ["__name:=other", "scan:=/front/scan"]
    program = HostedProgram(argv, {"ROS_MASTER_URI": URI, "ROS_NAMESPACE": "/robot"})
    node = await program.start(main())
    assert (node.name, node.master_uri, node.resolve("scan")) == ("/robot/other", URI, "/front/scan")
    program.stop("the test says so")
    assert node.is_shutdown


async def test_signals_are_for_the_process_not_for_a_hosted_node() -> None:
    async def main() -> bool:
        before = signal.getsignal(signal.SIGTERM)
        with stop_signals(lambda _: None):
            return signal.getsignal(signal.SIGTERM) is before

    assert await HostedProgram([], {}).start(main())


async def test_signal_tells_all_nodes_of_a_program_once() -> None:
    usual = signal.getsignal(signal.SIGTERM)
    told: list[str] = []
    with stop_signals(lambda reason: told.append(f"a {reason}")):
        with stop_signals(lambda reason: told.append(f"b {reason}")):
            signal.raise_signal(signal.SIGTERM)
            await until_handled(lambda: told)
            assert told == ["a received SIGTERM", "b received SIGTERM"]
            assert signal.getsignal(signal.SIGTERM) is usual
            with stop_signals(lambda reason: told.append(f"later {reason}")):
                pass
        with stop_signals(lambda reason: told.append(f"c {reason}")):
            signal.raise_signal(signal.SIGINT)
            await until_handled(lambda: told[2:])
    assert told[2:] == ["c received SIGINT"], "those of the first signal are told once"


async def test_node_that_ends_leaves_signals_to_the_others() -> None:
    usual = signal.getsignal(signal.SIGTERM)
    told: list[str] = []
    with ExitStack() as first, ExitStack() as second:
        first.enter_context(stop_signals(lambda _: told.append("first")))
        second.enter_context(stop_signals(lambda _: told.append("second")))
        first.close()
        assert signal.getsignal(signal.SIGTERM) is not usual
        signal.raise_signal(signal.SIGTERM)
        await until_handled(lambda: told)
    assert told == ["second"]
    with stop_signals(lambda _: None):
        assert signal.getsignal(signal.SIGTERM) is not usual
    assert signal.getsignal(signal.SIGTERM) is usual


async def until_handled(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(10):
        while not condition():
            await asyncio.sleep(0)


@pytest.mark.parametrize(("word", "code"), [("end", 0), ("fail", 1), ("exit", 3), ("lose", 1)])
async def test_end_of_a_hosted_node_has_the_code_of_a_process(module: str, word: str, code: int) -> None:
    lines: list[str] = []
    node = HostedNode(plan(), command(module, word), lines.append, StopTimeouts())
    assert await node.run() == code
    assert lines[0] == "/robot/tool: started in this process"
    assert lines[1] == ("/robot/tool: ended" if code == 0 else f"/robot/tool: ended with exit code {code}")


def test_end_by_a_signal_without_a_name_is_described() -> None:
    assert describe_end(-signal.SIGRTMIN - 1) == f"was ended by signal {signal.SIGRTMIN + 1}"


async def test_last_words_of_a_hosted_node_are_reported(module: str) -> None:
    """A process that ends with a text prints it, and its exit code is 1."""
    lines: list[str] = []
    node = HostedNode(plan(), command(module, "say"), lines.append, StopTimeouts())
    assert await node.run() == 1
    assert lines[1:] == ["/robot/tool: no map", "/robot/tool: ended with exit code 1"]


async def test_hosted_node_starts_again_until_it_is_told_to_end(module: str) -> None:
    starts = asyncio.Semaphore(0)
    node = HostedNode(
        plan(respawn=True),
        command(module, "fail"),
        lambda line: starts.release() if "started" in line else None,
        StopTimeouts(),
    )
    running = asyncio.create_task(node.run())
    for _ in range(3):
        await starts.acquire()
    node.stop()
    assert await running in (0, 1)
    assert len(sys.modules[module].runs) >= 2


async def test_hosted_node_that_waits_is_ended(module: str) -> None:
    started = asyncio.Event()
    node = HostedNode(plan(), command(module, "wait"), lambda _: started.set(), StopTimeouts())
    running = asyncio.create_task(node.run())
    await started.wait()
    node.stop()
    assert await running == 0


async def test_node_that_is_stopped_before_its_start_never_runs(module: str) -> None:
    lines: list[str] = []
    node = HostedNode(plan(respawn=True), command(module, "fail"), lines.append, StopTimeouts())
    node.stop()
    assert await node.run() == 0
    assert lines == []


def test_only_modules_without_prefix_are_hosted() -> None:
    found = node_command(
        NodePlan("/amcl", "amcl", "amcl", Place("main.launch", 1)), PackageIndex([]), {}, URI
    )
    assert (found.module, found.arguments) == ("rce_fleet.nodes.amcl", ("__name:=amcl",))
    assert can_host(plan(), found)
    assert not can_host(plan(prefix=("nice",)), found)
    relay = node_command(
        NodePlan("/relay", "topic_tools", "relay", Place("main.launch", 1)), PackageIndex([]), {}, URI
    )
    assert not can_host(plan(), relay)
