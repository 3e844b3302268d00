"""Actions between our nodes and those of ROS's own actionlib, both ways."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from support.roscpp_programs import compiled

from rce.ros.actions import (
    ActionClient,
    ActionServer,
    GoalFailedError,
    GoalState,
    ServerGoal,
    SimpleActionServer,
)
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.types import Time

pytestmark = [pytest.mark.needs("actionlib"), pytest.mark.timeout(300)]

TEST = "actionlib/TestAction"
SILENCE_S = 3.0

SERVERS = """
import threading
import actionlib, rospy
from actionlib.msg import TestAction, TestFeedback, TestResult

def execute(goal):
    simple.publish_feedback(TestFeedback(goal.goal + 1))
    if goal.goal < 0:
        simple.set_aborted(TestResult(goal.goal), "negative")
    elif goal.goal == 0:
        while not simple.is_preempt_requested():
            rospy.sleep(0.01)
        simple.set_preempted(TestResult(-1), "as asked")
    else:
        simple.set_succeeded(TestResult(2 * goal.goal), "doubled")

handles = {}

def goal_came(handle):
    number = handle.get_goal().goal
    if number < 0:
        handle.set_rejected(TestResult(number), "negative")
    elif number < 100:
        handle.set_accepted("on it")
        handles[handle.get_goal_id().id] = handle
        if number == 10:
            for key in list(handles):
                handles.pop(key).set_succeeded(TestResult(number), "all done")

def cancel_came(handle):
    handles.pop(handle.get_goal_id().id, None)
    handle.set_canceled(TestResult(-2), "cancelled")

rospy.init_node("real")
simple = actionlib.SimpleActionServer("simple", TestAction, execute, auto_start=False)
full = actionlib.ActionServer("full", TestAction, goal_came, cancel_came, auto_start=False)
simple.start()
full.start()
rospy.spin()
"""

CLIENT = """
import json, sys
import actionlib, rospy
from actionlib.msg import TestAction, TestGoal
from actionlib_msgs.msg import GoalStatus
from roscpp.srv import Empty

rospy.init_node("real")
report = {}
go = rospy.ServiceProxy("go", Empty)

simple = actionlib.SimpleActionClient("simple", TestAction)
assert simple.wait_for_server(rospy.Duration(200))

def run(number, cancel=False):
    heard = []
    def feedback(message):
        heard.append(message.feedback)
    simple.send_goal(TestGoal(number), feedback_cb=feedback)
    go()
    if cancel:
        while not heard:
            rospy.sleep(0.01)
        simple.cancel_goal()
    assert simple.wait_for_result(rospy.Duration(200))
    status = simple.get_state()
    return [heard, GoalStatus.to_string(status), simple.get_goal_status_text(), simple.get_result().result]

report["succeeded"] = run(3)
report["aborted"] = run(-1)
report["preempted"] = run(0, cancel=True)

many = actionlib.ActionClient("full", TestAction)
assert many.wait_for_server(rospy.Duration(200))
changes = {}
def changed(handle):
    changes.setdefault(handle.comm_state_machine.action_goal.goal.goal, []).append(
        actionlib.CommState.to_string(handle.get_comm_state()))
goals = {number: many.send_goal(TestGoal(number), changed) for number in (0, 1, 5, -1)}
def until(condition):
    end = rospy.Time.now() + rospy.Duration(200)
    while not condition():
        assert rospy.Time.now() < end, (changes, {n: g.get_goal_status() for n, g in goals.items()})
        rospy.sleep(0.01)
until(lambda: all(goals[n].get_comm_state() == actionlib.CommState.DONE for n in (5, -1)))
until(lambda: all(goals[n].get_goal_status() == GoalStatus.ACTIVE for n in (0, 1)))
goals[0].cancel()
until(lambda: goals[0].get_comm_state() == actionlib.CommState.DONE)
many.cancel_all_goals()
until(lambda: goals[1].get_comm_state() == actionlib.CommState.DONE)
until(lambda: all(changes.get(n, ["none"])[-1] == "DONE" for n in goals))  # callbacks come after the state
report["full"] = {n: [GoalStatus.to_string(g.get_terminal_state()), g.get_goal_status_text()]
                  for n, g in goals.items()}
report["changes"] = changes
print(json.dumps(report))
"""


def environment(core: Core, folder: Path) -> dict[str, str]:
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    return kept | {
        "ROS_MASTER_URI": core.uri,
        "ROS_IP": "127.0.0.1",
        "PATH": "/usr/bin:/bin",
        "HOME": str(folder),
    }


PROGRAMS = Path(__file__).parent / "programs"
LANGUAGES = ["rospy", pytest.param("roscpp", marks=pytest.mark.needs("roscpp_actionlib"))]
Peer = Callable[[str], AbstractAsyncContextManager[asyncio.subprocess.Process]]
"""Starts "servers" or "client" of a real actionlib."""


@pytest.fixture(params=LANGUAGES)
def peer(request: pytest.FixtureRequest, core: Core, tmp_path: Path) -> Peer:
    """A real actionlib's other end, in both languages."""
    if request.param == "rospy":
        script = tmp_path / "program.py"

        def start(what: str) -> AbstractAsyncContextManager[asyncio.subprocess.Process]:
            script.write_text({"servers": SERVERS, "client": CLIENT}[what])
            return program(core, tmp_path, "/usr/bin/python3", str(script))

        return start
    binary = compiled(PROGRAMS / "roscpp_actions.cpp", "actionlib", "roscpp")
    return lambda what: program(core, tmp_path, str(binary), what)


@asynccontextmanager
async def program(core: Core, folder: Path, *argv: str) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec(
        *argv,
        env=environment(core, folder),
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


@pytest.fixture
def node(core: Core) -> Node:
    return Node("ours", argv=[], master_uri=core.uri)


async def until_results_come(client: ActionClient) -> None:
    """Send goals that end at once: rospy greets a subscriber before it sends it anything."""
    while True:
        goal = await client.send(goal=-1)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SILENCE_S):
                if await goal.wait() is not GoalState.LOST:
                    return


async def test_our_client_at_a_simple_server(node: Node, peer: Peer) -> None:
    async with (
        peer("servers"),
        node,
        ActionClient(node, "simple", TEST, silence_timeout=30) as client,
        asyncio.timeout(200),
    ):
        await until_results_come(client)
        goal = await client.send(goal=3)
        assert (await goal.result()).result == 6
        assert goal.text == "doubled"

        with pytest.raises(GoalFailedError, match="aborted: negative") as caught:
            await (await client.send(goal=-5)).result()
        assert caught.value.result is not None
        assert caught.value.result.result == -5

        first = await client.send(goal=0)
        assert (await anext(aiter(first))).feedback == 1
        first.cancel()
        assert (await first.wait(), first.text) == (GoalState.PREEMPTED, "as asked")

        second = await client.send(goal=0)
        await anext(aiter(second))
        third = await client.send(goal=1)
        assert await second.wait() is GoalState.PREEMPTED
        assert (await third.result()).result == 2


async def test_our_client_at_a_full_server(node: Node, peer: Peer) -> None:
    async with (
        peer("servers") as process,
        node,
        asyncio.timeout(200),
    ):
        async with ActionClient(node, "full", TEST, silence_timeout=30) as client:
            await use_full_server(client)
        async with ActionClient(node, "full", TEST, silence_timeout=SILENCE_S) as client:
            await until_results_come(client)
            dying = await client.send(goal=5)
            process.kill()
            with pytest.raises(GoalFailedError, match="the server is silent"):
                await dying.result()
            assert dying.state is GoalState.LOST


async def use_full_server(client: ActionClient) -> None:
    await until_results_come(client)
    goals = [await client.send(goal=number) for number in (1, 2, 3, 4)]
    rejected = await client.send(goal=-1)
    assert (await rejected.wait(), rejected.text) == (GoalState.REJECTED, "negative")
    goals[1].cancel()
    assert (await goals[1].wait(), goals[1].text) == (GoalState.PREEMPTED, "cancelled")
    client.cancel_before(goals[0].stamp)
    assert await goals[0].wait() is GoalState.PREEMPTED
    waiting = await client.send(goal=100)
    waiting.cancel()
    assert await waiting.wait() is GoalState.RECALLED
    last = await client.send(goal=10)
    assert [(await goal.result()).result for goal in (goals[2], goals[3], last)] == [10, 10, 10]


async def answer(goal: ServerGoal) -> dict[str, Any] | None:
    number = goal.request.goal
    goal.publish_feedback(feedback=number + 1)
    if number < 0:
        goal.abort("negative", {"result": number})
        return None
    if number < 2:
        await goal.wait_for_cancel()
        goal.cancel("as asked", {"result": -1})
        return None
    return {"result": 2 * number}


async def choose(goal: ServerGoal) -> dict[str, Any] | None:
    if goal.request.goal < 0:
        goal.reject("negative")
        return None
    goal.accept()
    return await answer(goal)


@asynccontextmanager
async def ticking(core: Core, speed: float) -> AsyncIterator[None]:
    """Let time be simulated, and pass so many times as fast."""
    core.set_param("/use_sim_time", True)
    async with Node("world", argv=[], master_uri=core.uri) as world:
        clock = await world.advertise("/clock", "rosgraph_msgs/Clock")

        async def tick() -> None:
            seconds = 1.0  # real clients that begin before the first tick count from zero
            while True:
                clock.publish(clock=Time.from_sec(seconds))
                await asyncio.sleep(0.01)
                seconds += 0.01 * speed

        ticks = asyncio.create_task(tick())
        try:
            yield
        finally:
            ticks.cancel()
            await asyncio.wait([ticks])


async def test_real_clients_in_simulated_time(core: Core, node: Node, peer: Peer) -> None:
    async with ticking(core, speed=5.0):
        await test_real_clients_at_our_servers(node, peer)


async def test_real_clients_at_our_servers(node: Node, peer: Peer) -> None:
    go = asyncio.Semaphore(0)

    async def patient(goal: ServerGoal) -> dict[str, Any] | None:
        """Wait until the client knows of its goal: a real simple client forgets one that ends before."""
        await go.acquire()
        return await answer(goal)

    async with (
        node,
        SimpleActionServer(node, "simple", TEST, patient),
        ActionServer(node, "full", TEST, choose, auto_accept=False),
        asyncio.timeout(200),
    ):
        await node.advertise_service("go", "roscpp/Empty", lambda _: go.release())
        async with peer("client") as process:
            output, _ = await process.communicate()
    assert process.returncode == 0
    report = json.loads(output)
    # Feedback may be overtaken by the result, which has a connection of its own.
    assert report["succeeded"][1:] == ["SUCCEEDED", "", 6]
    assert report["aborted"][1:] == ["ABORTED", "negative", -1]
    assert report["preempted"] == [[1], "PREEMPTED", "as asked", -1]
    assert report["full"] == {
        "0": ["PREEMPTED", "as asked"],
        "1": ["PREEMPTED", "as asked"],
        "5": ["SUCCEEDED", ""],
        "-1": ["REJECTED", "negative"],
    }
    for changes in report["changes"].values():
        assert changes[-1] == "DONE"
    assert "PREEMPTING" in report["changes"]["1"]
