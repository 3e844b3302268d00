"""Owners of tasks: a block (:class:`TaskScope`), or an object that is closed (:class:`BackgroundTasks`).

:class:`asyncio.TaskGroup` waits for its tasks when its block ends; these classes cancel them. Use the task
group where the block is done when its tasks are.
"""

from __future__ import annotations

import asyncio
from itertools import islice
from typing import TYPE_CHECKING, Any, Self, TypeVar

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator
    from types import TracebackType

T = TypeVar("T")
E = TypeVar("E", bound=BaseException)


class TaskGroup(asyncio.TaskGroup):
    """A task group that loses no cancellation, as those of Python 3.13.

    In earlier ones, a block that is cancelled at the moment at which one of its tasks fails raises the task's
    error only: code that catches it goes on, and the cancellation never comes.
    """

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            await super().__aexit__(kind, error, trace)
        except BaseExceptionGroup:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                task.uncancel()
                task.cancel()  # comes with the next await
            raise


class TaskScope:
    """A task group whose end means "stop", not "wait": for the background work of a server or client.

    Leaving the block cancels the running tasks and waits for them. As with :class:`asyncio.TaskGroup`, a task
    that fails cancels the block, which raises its error in an exception group; an error of the block itself
    passes unchanged. Cancelling the block cancels the tasks too.

    Example:
        >>> async with TaskScope() as tasks:
        ...     tasks.spawn(send_heartbeats(), name="heartbeats")
        ...     await serve()
    """

    def __init__(self) -> None:
        self._group = TaskGroup()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._leaving = False

    async def __aenter__(self) -> Self:
        await self._group.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leaving = True
        for task in self._tasks:
            task.cancel()
        await self._group.__aexit__(None, None, None)

    def spawn(self, work: Coroutine[Any, Any, T], *, name: str) -> asyncio.Task[T]:
        """Run ``work`` as a task of this scope; a task spawned while the block is left is cancelled at once.

        Raises:
            RuntimeError: The scope has not begun or has ended.
        """
        task = self._group.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        if self._leaving:
            task.cancel()
        return task


class BackgroundTasks:
    """Owns the tasks of an object that is closed explicitly; its length is how many run.

    A task that fails is reported to the event loop's exception handler; the others continue. :meth:`close`
    ends them all.

    Example:
        >>> tasks = BackgroundTasks()
        >>> tasks.spawn(answer(request), name=f"request {request.id}")
        >>> await tasks.close()

    Attributes:
        closed: Whether :meth:`close` was called.
    """

    def __init__(self) -> None:
        self.closed = False
        self._tasks: set[asyncio.Task[Any]] = set()

    def __len__(self) -> int:
        return len(self._tasks)

    def spawn(self, work: Coroutine[Any, Any, T], *, name: str) -> asyncio.Task[T]:
        """Run ``work`` as a task that ends at the latest with :meth:`close`.

        Raises:
            RuntimeError: The owner is closed; ``work`` was not begun.
        """
        if self.closed:
            work.close()
            raise RuntimeError(f"{name} comes too late: its owner is closed")
        task = asyncio.get_running_loop().create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    async def close(self) -> None:
        """Cancel all tasks and wait until they have ended, except for the one that calls this.

        If this is cancelled, the tasks are cancelled already and end by themselves.
        """
        self.closed = True
        current = asyncio.current_task()
        tasks = [task for task in self._tasks if task is not current]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            context = {"message": f"task {task.get_name()} failed", "exception": error, "task": task}
            task.get_loop().call_exception_handler(context)


def errors_in(group: BaseExceptionGroup[E]) -> Iterator[E]:
    """Iterate over the errors of a group and of the groups in it: each task group adds one around them.

    Example:
        >>> group = ExceptionGroup("outer", [ExceptionGroup("inner", [OSError("no room")])])
        >>> next(errors_in(group))
        OSError('no room')
    """
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            yield from errors_in(error)
        else:
            yield error


def pass_cancellation(error: BaseException) -> None:
    """Raise ``error`` again if it is the cancellation of the present task; do nothing for any other error.

    What a task waits for may raise ``CancelledError`` too: because another task was cancelled that it waits
    for. That is an error like others, and does not ask this task to end.

    Raises:
        asyncio.CancelledError: The present task is being cancelled.

    Example:
        >>> try:
        ...     await callback()
        ... except (Exception, asyncio.CancelledError) as error:
        ...     pass_cancellation(error)
        ...     log.exception("the callback failed")
    """
    task = asyncio.current_task()
    if isinstance(error, asyncio.CancelledError) and task is not None and task.cancelling():
        raise error


async def cancel_and_wait(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks and wait until they have ended; their results and exceptions are dropped.

    For helpers of the caller whose outcome it has seen, or does not need any more.
    """
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def run_in_groups(works: Iterable[Callable[[], Awaitable[object]]], size: int) -> None:
    """Run functions, ``size`` of them side by side, and then the next.

    For many short requests to one server. One that fails does not stop those beside it, but the next are not
    begun: the server may be away.

    Raises:
        Exception: Of the first one that failed, when those beside it have ended.

    Example:
        >>> await run_in_groups([subscriber.close for subscriber in subscribers], 100)
    """
    rest = iter(works)
    while group := [work() for work in islice(rest, size)]:
        for result in await asyncio.gather(*group, return_exceptions=True):
            if isinstance(result, BaseException):
                raise result


async def finish(work: Coroutine[Any, Any, T]) -> T:
    """Run ``work`` to its end, also if the caller is cancelled meanwhile: for cleaning up.

    Raises:
        asyncio.CancelledError: The caller was cancelled; ``work`` has ended.
    """
    task = asyncio.create_task(work)
    cancelled: asyncio.CancelledError | None = None
    while not task.done():
        try:
            await asyncio.wait((task,))
        except asyncio.CancelledError as error:
            cancelled = error
    result = task.result()
    if cancelled is not None:
        raise cancelled
    return result


async def run_until_first(*works: Coroutine[Any, Any, object]) -> None:
    """Run coroutines side by side until one ends; then cancel the others and wait until they have ended.

    For the two directions of a connection, which ends when either ends. Cancellation cancels all.

    Raises:
        Exception: From the one that ended; exceptions of the others, as they are cancelled, are dropped.
    """
    tasks = [asyncio.create_task(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        await cancel_and_wait(*tasks)
