"""Requests of the fleet's API about tasks."""

from __future__ import annotations

import secrets
from collections.abc import AsyncIterator, Iterable

from rce_fleet.api.tasks import (
    CancelledTasks,
    HoldRequest,
    LoadRequest,
    TaskChange,
    TaskModel,
    TaskPage,
    TaskRequest,
)
from rce_fleet.client.requests import ApiRequests, if_match, parsed, path_part


class TaskRequests(ApiRequests):
    """Creates, reads and changes tasks."""

    async def create_task(self, task: TaskRequest, *, key: str = "") -> TaskModel:
        """Create a task.

        Args:
            task: The task.
            key: The caller's own key, such as the number of an order: a second request with the same key and
                content returns the first task. If empty, that of the task, or a random one.

        Example:
            ```python
            stops = [StopModel(action="pick", cell=12), StopModel(action="deliver", cell=40)]
            task = await fleet.create_task(TaskRequest(stops=stops, priority=5), key="order-4711")
            ```
        """
        # In the body: a header lacks the spaces around a key, and cannot have all characters.
        keyed = task.model_copy(update={"key": key or task.key or secrets.token_hex(16)})
        return await self._send("POST", "/tasks", TaskModel, keyed)

    async def task(self, task_id: str) -> TaskModel:
        """Return a task.

        Example:
            ```python
            print((await fleet.task("7")).state)
            ```
        """
        return await self._read(f"/tasks/{path_part(task_id)}", TaskModel)

    async def tasks(
        self,
        *,
        state: Iterable[str] = (),
        robot: str = "",
        requester: str = "",
        deadline_before: float | None = None,
        newest_first: bool = False,
    ) -> AsyncIterator[TaskModel]:
        """Yield tasks, page by page.

        Args:
            state: States to include, also ``open``, ``ended`` and ``recurring``; empty: all.
            robot: Only tasks that this robot does.
            requester: Only tasks of this user.
            deadline_before: Only tasks with a deadline before this time, seconds since 1970.
            newest_first: The newest first instead of the oldest.

        Example:
            ```python
            async for task in fleet.tasks(state=["open"]):
                print(task.id, task.state)
            ```
        """
        query = {"state": ",".join(state), "robot": robot, "requester": requester, "limit": "500"}
        query["deadline_before"] = "" if deadline_before is None else repr(deadline_before)
        query["order"] = "desc" if newest_first else "asc"
        while True:
            page = await self._read("/tasks", TaskPage, {key: text for key, text in query.items() if text})
            for task in page.tasks:
                yield task
            if page.next is None:
                return
            query["cursor"] = page.next

    async def change_task(
        self, task_id: str, change: TaskChange, *, revision: int | None = None
    ) -> TaskModel:
        """Change a task; with a revision, only if it was not changed since.

        Example:
            ```python
            task = await fleet.change_task("7", TaskChange(priority=9), revision=task.revision)
            ```
        """
        return await self._change("PATCH", f"/tasks/{path_part(task_id)}", TaskModel, change, revision)

    async def cancel_task(self, task_id: str, *, revision: int | None = None) -> TaskModel:
        """Cancel a task; a loaded robot brings its load back, and one that has ended recurs no further.

        Example:
            ```python
            await fleet.cancel_task("7")
            ```
        """
        return await self._change("DELETE", f"/tasks/{path_part(task_id)}", TaskModel, None, revision)

    async def cancel_tasks(
        self, *, state: Iterable[str] = (), robot: str = "", requester: str = ""
    ) -> list[str]:
        """Cancel many tasks, each as :meth:`cancel_task` does; return their ids.

        Tasks that have ended and recur no further are left as they are.

        Args:
            state: Only tasks in these states, also ``open``, ``ended`` and ``recurring``; empty: in all.
            robot: Only tasks that this robot does.
            requester: Only tasks of this user.

        Raises:
            ValueError: None of the three is given.

        Example:
            ```python
            await fleet.cancel_tasks(requester="erp", state=["queued"])
            ```
        """
        query = {"state": ",".join(state), "robot": robot, "requester": requester}
        given = {key: text for key, text in query.items() if text}
        if not given:
            raise ValueError("give state, robot or requester: state=['open'] cancels all")
        cancelled: list[str] = []
        while True:
            answer = parsed(CancelledTasks, await self._transport.request("DELETE", "/tasks", query=given))
            cancelled += answer.tasks
            if not answer.left:
                return cancelled

    async def hold_task(self, task_id: str, reason: str = "", *, revision: int | None = None) -> TaskModel:
        """Hold a task until :meth:`resume_task`.

        Example:
            ```python
            await fleet.hold_task("7", "the gate is closed")
            ```
        """
        path = f"/tasks/{path_part(task_id)}/hold"
        return await self._change("POST", path, TaskModel, HoldRequest(reason=reason), revision)

    async def resume_task(self, task_id: str, *, revision: int | None = None) -> TaskModel:
        """End the hold of a task.

        Example:
            ```python
            await fleet.resume_task("7")
            ```
        """
        return await self._change("POST", f"/tasks/{path_part(task_id)}/resume", TaskModel, None, revision)

    async def confirm_action(self, task_id: str, *, revision: int | None = None) -> TaskModel:
        """Confirm the action of a task that is under way; sent once.

        Example:
            ```python
            await fleet.confirm_action("7")
            ```
        """
        path = f"/tasks/{path_part(task_id)}/confirm"
        return await self._send("POST", path, TaskModel, headers=if_match(revision), repeatable=False)

    async def settle_load(self, task_id: str, cell: int | None, *, revision: int | None = None) -> TaskModel:
        """Say where the load of a task is whose robot does not come back; sent once.

        Args:
            task_id: The task; its ``question`` says that people have to decide.
            cell: Where the load is: any robot picks it up there and continues, and a cancelled task ends.
                None: it is lost, and the task fails.
            revision: The revision that the task must have; None: any.

        Example:
            ```python
            await fleet.settle_load("T7", cell=12)
            ```
        """
        path, body = f"/tasks/{path_part(task_id)}/load", LoadRequest(cell=cell)
        return await self._send("POST", path, TaskModel, body, headers=if_match(revision), repeatable=False)

    async def reassign_task(self, task_id: str, *, revision: int | None = None) -> TaskModel:
        """Take a task from its robot, so that another one gets it; sent once.

        Example:
            ```python
            await fleet.reassign_task("T7")
            ```
        """
        path = f"/tasks/{path_part(task_id)}/reassign"
        return await self._send("POST", path, TaskModel, headers=if_match(revision), repeatable=False)
