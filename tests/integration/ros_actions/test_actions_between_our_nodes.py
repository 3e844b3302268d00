"""Action servers and clients of ours, at our core."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, TypedDict, Unpack

import pytest
from support.ros_nodes import MakeNode

from rce.ros.actions import (
    ActionClient,
    ActionServer,
    ClientGoal,
    CommState,
    GoalFailedError,
    GoalId,
    GoalState,
    ServerGoal,
    SimpleActionServer,
)
from rce.ros.actions.ledger import Arrival
from rce.ros.actions.work import Handler
from rce.ros.core import Core
from rce.ros.errors import NodeClosedError
from rce.ros.node.master import MasterClient
from rce.ros.types import Message, SerializationError, Time

FIBONACCI = "actionlib_tutorials/FibonacciAction"


async def fibonacci(goal: ServerGoal) -> dict[str, Any]:
    sequence = [0, 1]
    for _ in range(goal.request.order):
        sequence.append(sequence[-1] + sequence[-2])
        goal.publish_feedback(sequence=sequence)
        await asyncio.sleep(0)
    return {"sequence": sequence}


async def until_cancelled(goal: ServerGoal) -> None:
    goal.publish_feedback(sequence=[goal.request.order])
    await goal.wait_for_cancel()


class ServerOptions(TypedDict, total=False):
    max_goals: int
    auto_accept: bool


@asynccontextmanager
async def pair(
    make_node: MakeNode,
    handler: Handler,
    *,
    server: type[ActionServer] = ActionServer,
    **options: Unpack[ServerOptions],
) -> AsyncIterator[tuple[ActionServer, ActionClient]]:
    async with (
        make_node("server") as a,
        make_node("client") as b,
        server(a, "job", FIBONACCI, handler, **options) as provider,
        ActionClient(b, "job", FIBONACCI, silence_timeout=20) as client,
    ):
        async with asyncio.timeout(30):
            yield provider, client


async def test_goal_feedback_result(make_node: MakeNode) -> None:
    heard = asyncio.Event()

    async def compute(goal: ServerGoal) -> dict[str, Any]:
        result = await fibonacci(goal)
        await heard.wait()  # the result has a connection of its own and could overtake feedback
        return result

    async with pair(make_node, compute) as (server, client):
        states: list[CommState] = []
        goal = await client.send(order=4, on_change=lambda goal: states.append(goal.comm_state))
        feedback = []
        async for message in goal:
            feedback.append(list(message.sequence))
            if len(feedback) == 4:
                heard.set()
        assert list((await goal.result()).sequence) == [0, 1, 1, 2, 3, 5]
        assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3], [0, 1, 1, 2, 3, 5]]
        assert goal.state is GoalState.SUCCEEDED
        assert states[-1] is CommState.DONE
        assert (client.goals, server.goals) == ((), ())


async def test_an_async_generator_yields_feedback(make_node: MakeNode) -> None:
    all_heard = asyncio.Event()
    heard: list[int] = []

    async def count(goal: ServerGoal) -> AsyncGenerator[dict[str, Any], None]:
        for number in range(goal.request.order):
            yield {"sequence": [number]}
        await all_heard.wait()
        goal.succeed({"sequence": [7]}, "counted")

    def hear(message: Message) -> None:
        heard.append(message.sequence[0])
        if len(heard) == 2:
            all_heard.set()

    async with pair(make_node, count) as (_, client):
        goal = await client.send({"order": 2}, on_feedback=hear)
        assert list((await goal.result()).sequence) == [7]
        assert (heard, goal.text) == ([0, 1], "counted")


async def test_many_goals_at_the_same_time(make_node: MakeNode) -> None:
    async with pair(make_node, until_cancelled, max_goals=3) as (server, client):
        goals = [await client.send(order=order) for order in range(3)]
        for order, goal in enumerate(goals):
            assert list((await anext(aiter(goal))).sequence) == [order]
        assert [goal.request.order for goal in server.goals] == [0, 1, 2]
        refused = await client.send(order=3)
        with pytest.raises(GoalFailedError, match="rejected: the server works on 3 goals already"):
            await refused.result()
        goals[1].cancel()
        assert await goals[1].wait() is GoalState.PREEMPTED
        assert goals[0].state is not GoalState.PREEMPTED
        client.cancel_before(goals[0].stamp)
        assert await goals[0].wait() is GoalState.PREEMPTED
        client.cancel_all()
        assert await goals[2].wait() is GoalState.PREEMPTED


async def test_a_cancelled_goal_keeps_its_result(make_node: MakeNode) -> None:
    async def stubborn(goal: ServerGoal) -> None:
        while await goal.sleep(0.01):
            goal.publish_feedback()
        goal.cancel("enough", {"sequence": [1]})

    async with pair(make_node, stubborn) as (_, client):
        goal = await client.send(order=1)
        await anext(aiter(goal))
        goal.cancel()
        with pytest.raises(GoalFailedError, match="preempted: enough") as caught:
            await goal.result()
        assert caught.value.state is GoalState.PREEMPTED
        assert caught.value.result is not None
        assert list(caught.value.result.sequence) == [1]
        goal.cancel()


async def test_accepting_is_the_handlers_choice(make_node: MakeNode) -> None:
    async def choosy(goal: ServerGoal) -> dict[str, Any] | None:
        if goal.request.order == 0:
            goal.reject("too easy")
        elif goal.request.order == 1:
            await goal.wait_for_cancel()
            goal.cancel("never begun")
        elif goal.request.order == 2:
            goal.accept("well")
            goal.abort("too hard", {"sequence": [2]})
        return None

    async with pair(make_node, choosy, auto_accept=False) as (_, client):
        for order, state, text in (
            (0, GoalState.REJECTED, "too easy"),
            (1, GoalState.RECALLED, "never begun"),
            (2, GoalState.ABORTED, "too hard"),
            (3, GoalState.REJECTED, "the server did not accept the goal"),
        ):
            goal = await client.send(order=order)
            if order == 1:
                goal.cancel()
            assert (await goal.wait(), goal.text) == (state, text)


async def test_a_handler_that_fails_aborts_its_goal(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    async def fail(goal: ServerGoal) -> dict[str, Any]:
        if goal.request.order:
            raise ZeroDivisionError("by nothing")
        return {"sequence": "no numbers"}

    async with pair(make_node, fail) as (_, client):
        with pytest.raises(GoalFailedError, match="aborted: ZeroDivisionError: by nothing"):
            await (await client.send(order=1)).result()
        with pytest.raises(GoalFailedError, match=r"aborted: SerializationError: .*sequence"):
            await (await client.send(order=0)).result()
        assert "the handler of /job failed" in caplog.text
        with pytest.raises(SerializationError):
            await client.send(order="many")


async def test_error_text_that_utf8_cannot_hold_ends_only_its_goal(
    make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        logging.getLogger("rce.ros.actions.server"), "disabled", True
    )  # pytest cannot send it

    async def fail(goal: ServerGoal) -> dict[str, Any]:
        if goal.request.order:
            raise ValueError("no map caf\udce9")
        return {"sequence": [1]}

    async with pair(make_node, fail) as (_, client):
        with pytest.raises(GoalFailedError, match=r"aborted: ValueError: no map caf\\udce9"):
            await (await client.send(order=1)).result()
        assert list((await (await client.send(order=0)).result()).sequence) == [1]


async def test_a_simple_server_works_on_the_newest_goal(make_node: MakeNode) -> None:
    async with pair(make_node, until_cancelled, server=SimpleActionServer) as (server, client):
        first = await client.send(order=1)
        await anext(aiter(first))
        second = await client.send(order=2)
        assert await first.wait() is GoalState.PREEMPTED
        assert list((await anext(aiter(second))).sequence) == [2]
        assert [goal.request.order for goal in server.goals] == [2]


async def test_waiting_goals_are_replaced_and_recalled(make_node: MakeNode) -> None:
    """Goals that wait at a simple server are replaced and recalled."""
    release = asyncio.Event()

    async def slow(goal: ServerGoal) -> dict[str, Any]:
        goal.publish_feedback()
        await release.wait()
        return {"sequence": [goal.request.order]}

    async with pair(make_node, slow, server=SimpleActionServer) as (_, client):
        first = await client.send(order=1)
        await anext(aiter(first))
        second = await client.send(order=2)
        third = await client.send(order=3)
        assert (await second.wait(), second.text) == (GoalState.RECALLED, "another goal came")
        third.cancel()
        assert await third.wait() is GoalState.RECALLED
        fourth = await client.send(order=4)
        release.set()
        assert list((await first.result()).sequence) == [1]
        assert list((await fourth.result()).sequence) == [4]


async def test_waiting_goal_starts_after_a_stray_cancellation(make_node: MakeNode) -> None:
    """The handler waits for a task of its own that is cancelled; the server is not."""

    async def waits_for_cancelled_task(goal: ServerGoal) -> dict[str, Any]:
        if goal.request.order == 1:
            helper = asyncio.ensure_future(asyncio.sleep(60))
            await goal.wait_for_cancel()
            helper.cancel()
            await helper
        return {"sequence": [goal.request.order]}

    async with pair(make_node, waits_for_cancelled_task, server=SimpleActionServer) as (_, client):
        first = await client.send(order=1)
        second = await client.send(order=2)
        async with asyncio.timeout(20):
            assert list((await second.result()).sequence) == [2]
            with pytest.raises(GoalFailedError, match="CancelledError"):
                await first.result()


async def test_a_server_that_stops_aborts_its_goals(make_node: MakeNode) -> None:
    async with make_node("client") as b, ActionClient(b, "job", FIBONACCI) as client:
        async with make_node("server") as a, SimpleActionServer(a, "job", FIBONACCI, until_cancelled):
            goal = await client.send(order=1)
            await anext(aiter(goal))
        with pytest.raises(GoalFailedError, match="aborted: the server stopped"):
            await goal.result(20)


async def test_a_server_that_starts_anew_has_lost_the_goal(core: Core, make_node: MakeNode) -> None:
    async with make_node("client") as b, ActionClient(b, "job", FIBONACCI) as client:
        async with asyncio.timeout(30):
            async with make_node("server") as a:
                # A server that dies without a word: its status topic alone.
                status = await a.advertise("job/status", "actionlib_msgs/GoalStatusArray", latch=True)
                for topic, kind in (("result", "ActionResult"), ("feedback", "ActionFeedback")):
                    await a.advertise(f"job/{topic}", f"actionlib_tutorials/Fibonacci{kind}")
                goals = await a.subscribe("job/goal", "actionlib_tutorials/FibonacciActionGoal")
                await a.subscribe("job/cancel", "actionlib_msgs/GoalID", lambda _: None)
                status.publish()
                active = asyncio.Event()

                def note(goal: ClientGoal) -> None:
                    if goal.comm_state is CommState.ACTIVE:
                        active.set()

                goal = await client.send(order=1, on_change=note)
                received = await anext(aiter(goals))
                status.publish(status_list=[{"goal_id": {"id": received.goal_id.id}, "status": 1}])
                await active.wait()
            async with make_node("server") as a, ActionServer(a, "job", FIBONACCI, fibonacci):
                with pytest.raises(GoalFailedError, match="does not list the goal any longer"):
                    await goal.result()
                assert goal.state is GoalState.LOST


async def test_a_silent_server_loses_the_goal(make_node: MakeNode) -> None:
    async with (
        make_node("server") as a,
        make_node("client") as b,
        ActionServer(a, "job", FIBONACCI, until_cancelled),
        ActionClient(b, "job", FIBONACCI, silence_timeout=0.01) as client,
    ):
        goal = await client.send(order=1)
        with pytest.raises(GoalFailedError, match="the server is silent"):
            await goal.result(20)


async def test_callbacks_of_a_goal_that_fail_do_not_end_the_client(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    """The client itself reports the loss, from the task that looks after its goals."""

    def fail(_: object) -> None:
        raise RuntimeError("broken callback")

    async with (
        make_node("server") as a,
        make_node("client") as b,
        ActionServer(a, "job", FIBONACCI, until_cancelled),
        ActionClient(b, "job", FIBONACCI, silence_timeout=0.01) as client,
    ):
        async with asyncio.timeout(30):
            for _ in range(2):
                goal = await client.send(order=1, on_change=fail, on_feedback=fail)
                with pytest.raises(GoalFailedError, match="the server is silent"):
                    await goal.result()
    assert "broken callback" in caplog.text


async def test_a_goal_that_got_lost_on_the_way_is_sent_again(
    make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with pair(make_node, fibonacci) as (server, client):
        receive = server._ledger.receive
        lost: list[GoalId] = []

        def lose_once(goal_id: GoalId, now: float) -> Arrival:
            if lost:
                return receive(goal_id, now)
            lost.append(goal_id)
            return Arrival.REPEATED

        monkeypatch.setattr(server._ledger, "receive", lose_once)
        goal = await client.send(order=1)
        assert list((await goal.result()).sequence) == [0, 1, 1]
        assert len(lost) == 1


async def test_leaving_with_an_unheard_goal_keeps_the_error(
    make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A goal that is sent again meets no closed publisher while the master is slow."""
    monkeypatch.setattr("rce.ros.actions.client.TICK", 0.001)
    monkeypatch.setattr("rce.ros.actions.tracker.REPEAT_AFTER", 0.0)
    unregister = MasterClient.unregister_publisher

    async def unregister_slowly(master: MasterClient, topic: str) -> None:
        await asyncio.sleep(0.1 if topic == "/job/goal" else 0)
        await unregister(master, topic)

    async def fail_with_a_goal_under_way() -> None:
        async with pair(make_node, fibonacci) as (server, client):
            monkeypatch.setattr(server._ledger, "receive", lambda *_: Arrival.REPEATED)
            await client.send(order=1)
            raise ZeroDivisionError

    monkeypatch.setattr(MasterClient, "unregister_publisher", unregister_slowly)
    with pytest.raises(ZeroDivisionError):
        await fail_with_a_goal_under_way()


async def test_waiting_has_an_end(make_node: MakeNode) -> None:
    async with make_node("client") as b, ActionClient(b, "job", FIBONACCI) as client:
        with pytest.raises(TimeoutError):
            await client.wait_for_server(0.01)
    async with pair(make_node, until_cancelled) as (_, client):
        goal = await client.send(order=1)
        with pytest.raises(TimeoutError):
            await goal.result(0.01)
        assert not goal.is_done


async def test_waiting_for_a_server_ends_with_the_node(make_node: MakeNode) -> None:
    async with make_node("client") as b, ActionClient(b, "job", FIBONACCI) as client, asyncio.timeout(10):
        waiting = [asyncio.ensure_future(one) for one in (client.wait_for_server(), client.send(order=1))]
        await asyncio.sleep(0.05)
        b.shutdown("test")
        outcomes = await asyncio.gather(*waiting, return_exceptions=True)
        assert [type(outcome) for outcome in outcomes] == [NodeClosedError] * 2


async def test_goals_end_for_a_client_that_leaves_or_whose_node_stops(make_node: MakeNode) -> None:
    async with pair(make_node, until_cancelled) as (_, client):
        goal = await client.send(order=1)
        client._node.shutdown("test")
        with pytest.raises(GoalFailedError, match="the node stops"):
            await goal.result()
    async with pair(make_node, until_cancelled) as (_, client):
        goal = await client.send(order=1)
    with pytest.raises(GoalFailedError, match="the client was closed"):
        await goal.result()


async def test_what_servers_publish_and_remember(core: Core, make_node: MakeNode) -> None:
    """As real actionlib: a latched list, five times a second, with goals that are over for some seconds."""
    core.set_param("/actionlib_status_frequency", 50)
    core.set_param("/job/status_list_timeout", 1.0)  # longer than a loaded machine stands still
    async with pair(make_node, fibonacci) as (_, client):
        lists = await client._node.subscribe("job/status", "actionlib_msgs/GoalStatusArray")
        assert (await anext(aiter(lists))).status_list == []
        goal = await client.send(order=1)
        seen = set()
        async for message in lists:
            seen |= {(status.goal_id.id, status.status) for status in message.status_list}
            if seen and not message.status_list:
                break
        assert seen - {(goal.id, 0)} == {(goal.id, 1), (goal.id, 3)}, "pending, if it was seen so early"


async def test_goals_without_name_and_time_get_both(make_node: MakeNode) -> None:
    async with make_node("server") as a, make_node("client") as b:
        arrived: asyncio.Queue[ServerGoal] = asyncio.Queue()

        async def keep(goal: ServerGoal) -> None:
            arrived.put_nowait(goal)

        async with ActionServer(a, "job", FIBONACCI, keep):
            publisher = await b.advertise("job/goal", "actionlib_tutorials/FibonacciActionGoal")
            await publisher.wait_for_subscribers(timeout=20)
            publisher.publish(goal={"order": 5})
            goal = await asyncio.wait_for(arrived.get(), 20)
            assert goal.id.startswith("/server-")
            assert abs(goal.stamp.to_sec() - Time.now().to_sec()) < 60
