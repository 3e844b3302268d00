"""A node's registrations at its master, each shared by all handles of its topic or service."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from weakref import WeakValueDictionary

from rce.aio.backoff import Backoff
from rce.aio.tasks import TaskScope
from rce.ros.errors import MasterError, MasterUnreachableError, NodeClosedError

_log = logging.getLogger(__name__)

RETRY = Backoff(first=0.2, longest=15.0, jitter=0.5)
"""Pauses between attempts to take back a registration that nothing needs."""

BUSY_S = 60.0
"""For how long a master that does not answer in time is asked again, by a node that starts or registers."""

MasterCall = Callable[[], Awaitable[object]]


class Registrations:
    """Makes and takes back the registrations of one node.

    A master may carry out a call whose caller has given up. Hence a registration runs in a task of the node
    and is not cancelled with its caller, calls about one subject are made one after the other, and what
    failed or is not needed any longer is taken back.
    """

    def __init__(self, node_name: str, tasks: TaskScope) -> None:
        self.node_name = node_name
        self._tasks = tasks
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._abandoned: dict[str, Registration] = {}
        self._closed = False

    def begin(
        self, subject: str, *, register: MasterCall, unregister: MasterCall, is_needed: Callable[[], bool]
    ) -> Registration:
        """Begin to register.

        Args:
            subject: What is registered, such as ``publisher of /tf``: calls about it are made in order.
            register: Registers it.
            unregister: Unregisters it.
            is_needed: Returns whether the node has handles of the subject, of this registration or a later
                one.

        Raises:
            NodeClosedError: The node has left the graph.
        """
        if self._closed:
            raise NodeClosedError(f"node {self.node_name} has left the graph")
        lock = self._locks.setdefault(subject, asyncio.Lock())
        registration = Registration(self, subject, unregister, is_needed, lock)
        registration.start(self._tasks, register)
        return registration

    def abandon(self, registration: Registration) -> None:
        """Take a registration back in the background, however long the master is away."""
        if self._closed or registration.subject in self._abandoned:
            return
        self._abandoned[registration.subject] = registration
        self._tasks.spawn(self._take_back(registration), name=f"unregister {registration.subject}")

    async def take_back_abandoned(self) -> None:
        """Take back at once what was abandoned.

        Raises:
            MasterError: The master does not take it.
        """
        for registration in list(self._abandoned.values()):
            await registration.end()

    def close(self) -> None:
        """Begin and abandon nothing any more: the node's tasks end."""
        self._closed = True

    async def _take_back(self, registration: Registration) -> None:
        pauses = RETRY.start()
        try:
            while True:
                try:
                    await registration.end()
                except MasterUnreachableError as error:
                    _log.debug("%s is still registered: %s", registration.subject, error)
                except MasterError as error:
                    _log.info("%s is not unregistered: %s", registration.subject, error)
                    return
                else:
                    return
                await asyncio.sleep(pauses.next())
        finally:
            del self._abandoned[registration.subject]


class Registration:
    """One topic or service of a node at its master. Made by :meth:`Registrations.begin`."""

    def __init__(
        self,
        owner: Registrations,
        subject: str,
        unregister: MasterCall,
        is_needed: Callable[[], bool],
        lock: asyncio.Lock,
    ) -> None:
        self.subject = subject
        self._owner = owner
        self._unregister = unregister
        self._is_needed = is_needed
        self._lock = lock
        self._is_taken_back = False
        self._task: asyncio.Task[Exception | None]

    def start(self, tasks: TaskScope, register: MasterCall) -> None:
        """Register, in a task."""
        self._task = tasks.spawn(self._register(register), name=f"register {self.subject}")

    async def wait(self) -> None:
        """Wait until it is made; cancelling one caller does not affect the others.

        Raises:
            MasterError: The registration at the master failed.
            NodeClosedError: The node left the graph before.
        """
        await asyncio.wait((self._task,))
        if self._task.cancelled():
            raise NodeClosedError(f"node {self._owner.node_name} has left the graph")
        error = self._task.result()
        if error is not None:
            raise error

    def abandon(self) -> None:
        """Take it back in the background: it failed, or its last handle was cancelled."""
        self._owner.abandon(self)

    async def release(self) -> None:
        """Take it back, as :meth:`end`; in the background if that fails or is cancelled.

        Raises:
            MasterError: The master does not take it now.
        """
        try:
            await self.end()
        except BaseException:
            self.abandon()
            raise

    async def end(self) -> None:
        """Take it back, unless the subject is needed again.

        Raises:
            MasterError: The master does not take it.
        """
        async with self._lock:
            # A node that leaves waits for what is being taken back in the background.
            if not (self._is_taken_back or self._is_needed()):
                await self._unregister()
                self._is_taken_back = True

    async def _register(self, register: MasterCall) -> Exception | None:
        """Return the error instead of raising it: every handle gets it, and the node continues.

        A master that is busy is asked again, which does no harm if it has carried the call out.
        """
        loop = asyncio.get_running_loop()
        async with self._lock:
            deadline = loop.time() + BUSY_S
            while self._is_needed():
                try:
                    await register()
                except Exception as error:  # noqa: BLE001 - raised by wait()
                    is_late = isinstance(error, MasterUnreachableError) and error.is_late
                    if not is_late or loop.time() >= deadline:
                        return error
                    _log.info("%s: %s; trying again", self.subject, error)
                else:
                    break
        return None
