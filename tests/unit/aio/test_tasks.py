"""Owners of tasks."""

from __future__ import annotations

import asyncio
from functools import partial

import pytest

from rce.aio.tasks import (
    BackgroundTasks,
    TaskGroup,
    TaskScope,
    cancel_and_wait,
    finish,
    pass_cancellation,
    run_in_groups,
    run_until_first,
)

Reported = list[BaseException]


async def for_ever() -> None:
    await asyncio.Event().wait()


async def fail() -> None:
    raise ValueError("broken")


@pytest.fixture
async def reported() -> Reported:
    """What is reported to the event loop's exception handler."""
    found: Reported = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: found.append(context["exception"]))
    return found


@pytest.mark.parametrize("owner", ["group", "scope"])
async def test_no_cancellation_is_lost_beside_a_failure(owner: str) -> None:
    """A program is told to end at the moment at which its master ends, and its connection with it."""
    caught: list[str] = []

    async def end_all() -> None:
        await asyncio.sleep(0)
        trying.cancel()
        raise ValueError("broken")

    async def run_once() -> None:
        if owner == "group":
            async with TaskGroup() as group:
                group.create_task(end_all())
                await for_ever()
        else:
            async with TaskScope() as scope:
                scope.spawn(end_all(), name="end")
                await for_ever()

    async def try_again() -> None:
        try:
            await run_once()
        except* ValueError:
            caught.append(owner)
        await for_ever()

    trying = asyncio.create_task(try_again())
    await asyncio.wait([trying], timeout=5.0)
    is_over = trying.cancelled()
    trying.cancel()
    assert (is_over, caught) == (True, [owner])


async def test_leaving_a_scope_cancels_what_runs() -> None:
    async with TaskScope() as scope:
        task = scope.spawn(for_ever(), name="sleeper")
    assert task.cancelled()
    assert task.get_name() == "sleeper"


async def test_leaving_a_scope_waits_for_what_a_task_does_last() -> None:
    done: list[str] = []

    async def tidy() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            done.append("tidied")

    async with TaskScope() as scope:
        scope.spawn(tidy(), name="tidy")
        await asyncio.sleep(0)
    assert done == ["tidied"]


async def test_what_is_spawned_while_leaving_does_nothing() -> None:
    done: list[str] = []
    spawned: list[asyncio.Task[None]] = []

    async def late() -> None:
        done.append("late")

    async def last_words(scope: TaskScope) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            spawned.append(scope.spawn(late(), name="late"))

    async with TaskScope() as scope:
        scope.spawn(last_words(scope), name="speaker")
        await asyncio.sleep(0)
    assert spawned[0].cancelled()
    assert done == []


async def test_a_failing_task_ends_the_block() -> None:
    async def block() -> None:
        async with TaskScope() as scope:
            scope.spawn(fail(), name="failing")
            await asyncio.Event().wait()

    with pytest.raises(ExceptionGroup) as caught:
        await block()
    assert caught.group_contains(ValueError, match="broken")


async def test_an_error_of_the_block_passes_unchanged() -> None:
    tasks: list[asyncio.Task[None]] = []

    async def block() -> None:
        async with TaskScope() as scope:
            tasks.append(scope.spawn(for_ever(), name="sleeper"))
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        await block()
    assert tasks[0].cancelled()


async def test_cancelling_the_block_cancels_its_tasks() -> None:
    inside: list[asyncio.Task[None]] = []
    begun = asyncio.Event()

    async def block() -> None:
        async with TaskScope() as scope:
            inside.append(scope.spawn(for_ever(), name="sleeper"))
            begun.set()
            await asyncio.Event().wait()

    outer = asyncio.create_task(block())
    await begun.wait()
    outer.cancel()
    with pytest.raises(asyncio.CancelledError):
        await outer
    assert inside[0].cancelled()


async def test_a_scope_that_has_ended_takes_no_task() -> None:
    async with TaskScope() as scope:
        pass
    work = for_ever()
    with pytest.raises(RuntimeError):
        scope.spawn(work, name="late")
    work.close()


async def test_background_failure_is_reported_and_others_go_on(reported: Reported) -> None:
    tasks = BackgroundTasks()
    failing = tasks.spawn(fail(), name="failing")
    lasting = tasks.spawn(for_ever(), name="lasting")
    await asyncio.wait([failing])
    await asyncio.sleep(0)
    assert [str(error) for error in reported] == ["broken"]
    assert not lasting.done()
    assert len(tasks) == 1
    await tasks.close()
    assert lasting.cancelled()
    assert len(tasks) == 0


async def test_a_closed_owner_takes_no_task(reported: Reported) -> None:
    tasks = BackgroundTasks()
    await tasks.close()
    assert tasks.closed
    with pytest.raises(RuntimeError, match="late comes too late: its owner is closed"):
        tasks.spawn(for_ever(), name="late")
    assert reported == []


async def test_a_background_task_can_close_its_owner() -> None:
    tasks = BackgroundTasks()
    other = tasks.spawn(for_ever(), name="other")

    async def closing() -> str:
        await tasks.close()
        return "closed"

    assert await tasks.spawn(closing(), name="closing") == "closed"
    assert other.cancelled()


async def test_a_cancelled_close_has_cancelled_the_tasks() -> None:
    tasks = BackgroundTasks()
    release = asyncio.Event()

    async def slow() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await release.wait()

    task = tasks.spawn(slow(), name="slow")
    await asyncio.sleep(0)
    closing = asyncio.create_task(tasks.close())
    await asyncio.sleep(0)
    closing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await closing
    assert not task.done()
    release.set()
    await asyncio.wait([task])
    assert task.cancelled()


async def test_cancel_and_wait_waits_for_every_task(reported: Reported) -> None:
    failing, lasting = asyncio.create_task(fail()), asyncio.create_task(for_ever())
    await asyncio.sleep(0)
    await cancel_and_wait(failing, lasting)
    assert failing.done()
    assert lasting.cancelled()
    assert reported == []


async def test_run_until_first_cancels_the_others() -> None:
    ended: list[str] = []

    async def last_words() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            ended.append("cancelled")

    async def short() -> None:
        await asyncio.sleep(0)
        ended.append("first")

    await run_until_first(last_words(), short())
    assert ended == ["first", "cancelled"]


async def test_run_until_first_raises_what_the_first_raised() -> None:
    with pytest.raises(ValueError, match="broken"):
        await run_until_first(for_ever(), fail())


async def test_cancelling_run_until_first_cancels_all() -> None:
    ended: list[int] = []
    begun = asyncio.Barrier(3)

    async def wait(number: int) -> None:
        await begun.wait()
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(number)

    running = asyncio.create_task(run_until_first(wait(1), wait(2)))
    await begun.wait()
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running
    assert sorted(ended) == [1, 2]


async def test_finish_ends_its_work_before_the_caller_is_cancelled() -> None:
    steps: list[int] = []

    async def clean_up() -> int:
        for step in range(4):
            steps.append(step)
            await asyncio.sleep(0.01)
        return 7

    task = asyncio.create_task(finish(clean_up()))
    for _ in range(2):
        await asyncio.sleep(0)
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert steps == [0, 1, 2, 3]
    assert await finish(clean_up()) == 7


async def test_finish_raises_the_error_of_its_work() -> None:
    async def fail() -> None:
        raise ValueError("no room")

    with pytest.raises(ValueError, match="no room"):
        await finish(fail())


async def test_pass_cancellation_raises_only_that_of_the_present_task() -> None:
    pass_cancellation(OSError())
    pass_cancellation(asyncio.CancelledError())  # of a task that this one waited for

    async def wait() -> None:
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError as error:
            pass_cancellation(error)

    waiting = asyncio.create_task(wait())
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.wait((waiting,))
    assert waiting.cancelled()


async def test_groups_run_one_after_the_other() -> None:
    running, most, done = 0, 0, 0

    async def work() -> None:
        nonlocal running, most, done
        running += 1
        most = max(most, running)
        await asyncio.sleep(0)
        running -= 1
        done += 1

    await run_in_groups([work] * 25, 10)
    assert (done, most) == (25, 10)


async def test_failure_ends_its_group_but_not_the_works_in_it() -> None:
    done: list[int] = []

    async def work(number: int) -> None:
        await asyncio.sleep(0)
        if number in (1, 2):
            raise ValueError(f"number {number}")
        done.append(number)

    with pytest.raises(ValueError, match="number 1"):
        await run_in_groups([partial(work, number) for number in range(8)], 4)
    assert done == [0, 3]
