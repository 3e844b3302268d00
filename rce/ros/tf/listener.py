"""The listener, which receives transforms from the graph."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rce.aio.tasks import TaskScope
from rce.ros.closing import release
from rce.ros.errors import NodeClosedError
from rce.ros.tf.broadcaster import KIND, TF, TF_STATIC, find_prefix
from rce.ros.tf.buffer import Buffer
from rce.ros.tf.exceptions import (
    BadTransformError,
    ConnectivityError,
    ExtrapolationError,
    TransformTimeoutError,
    UnknownFrameError,
)
from rce.ros.tf.frames import resolve
from rce.ros.tf.stamped import StampedTransform

if TYPE_CHECKING:
    from rce.ros.node import Node
    from rce.ros.types import Message, Time

_log = logging.getLogger(__name__)

JUMP = 1.0
"""Seconds that time must jump back for the buffer to forget: a simulation or a bag began again."""

MAX_WARNINGS = 100
"""For how many different frames warnings are logged."""

_A_LONG_TIME = 3600.0


class TransformListener:
    """Fills a buffer from ``/tf`` and ``/tf_static`` and answers from it. An async context manager.

    ``async with TransformListener(node) as tf: pose = await tf.wait_for("map", "base_link", timeout=1.0)``

    Attributes:
        buffer: The received transforms, with full names of frames.
        prefix: The prefix of frames in lookups whose names do not begin with a slash.
    """

    def __init__(self, node: Node, buffer: Buffer | None = None, *, prefix: str | None = None) -> None:
        """Prepare a listener.

        Args:
            node: The node that it is part of; it must be running while the listener is.
            buffer: Keeps the received transforms; None: a new one.
            prefix: The prefix of the frames; None: the parameter ``tf_prefix``.
        """
        self.buffer = buffer if buffer is not None else Buffer()
        self.prefix = prefix or ""
        self._search = prefix is None
        self._node = node
        self._stack = AsyncExitStack()
        self._changed = asyncio.Event()
        self._stopped = False
        self._latest = 0.0
        self._warned_of: set[str] = set()

    # Life

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            if self._search:
                self.prefix = await find_prefix(self._node)
            stack.callback(self._stop)
            tasks = await stack.enter_async_context(TaskScope())
            tasks.spawn(self._notice_stop(), name=f"tf of {self._node.name}")
            for topic, static in ((TF_STATIC, True), (TF, False)):
                take = partial(self._received, static=static)
                stack.push_async_callback(release, await self._node.subscribe(topic, KIND, take))
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def _notice_stop(self) -> None:
        while await self._node.sleep(_A_LONG_TIME):
            pass
        self._stop()

    def _stop(self) -> None:
        self._stopped = True
        self._changed.set()

    # For programs

    def lookup(self, target: str, source: str, time: Time | None = None) -> StampedTransform:
        """Return ``target_from_source``; as :meth:`rce.ros.tf.Buffer.lookup`, below the prefix.

        Raises:
            TransformError: It is not known.
        """
        return self._fresh_buffer().lookup(self.resolve(target), self.resolve(source), time)

    def lookup_full(
        self, target: str, target_time: Time | None, source: str, source_time: Time | None, fixed: str
    ) -> StampedTransform:
        """Return ``target_from_source`` between two times; as :meth:`rce.ros.tf.Buffer.lookup_full`.

        Raises:
            TransformError: It is not known.
        """
        return self._fresh_buffer().lookup_full(
            self.resolve(target), target_time, self.resolve(source), source_time, self.resolve(fixed)
        )

    def can_transform(self, target: str, source: str, time: Time | None = None) -> bool:
        """Return whether :meth:`lookup` has an answer."""
        return self._fresh_buffer().can_transform(self.resolve(target), self.resolve(source), time)

    async def wait_for(
        self, target: str, source: str, time: Time | None = None, *, timeout: float | None = None
    ) -> StampedTransform:
        """Return ``target_from_source`` as soon as it is known.

        Args:
            target: The frame to take coordinates to.
            source: The frame to take them from.
            time: When; zero or None: as soon as there is any answer.
            timeout: Real seconds to wait; None: without a limit.

        Raises:
            TransformTimeoutError: It did not become known in time; the cause says why.
            ExtrapolationError: ``time`` is before the times in the buffer: waiting does not help.
            FrameLoopError: The frames are not a tree.
            NodeClosedError: The node stops.
        """
        try:
            async with asyncio.timeout(timeout):
                while True:
                    try:
                        return self.lookup(target, source, time)
                    except (UnknownFrameError, ConnectivityError, ExtrapolationError) as error:
                        if time and isinstance(error, ExtrapolationError) and not error.is_future:
                            raise
                        reason = error
                    await self._next_change()
        except TimeoutError as error:
            assert timeout is not None
            raise TransformTimeoutError(timeout, reason) from error

    def resolve(self, frame: str) -> str:
        """Return the full name of a frame."""
        return resolve(self.prefix, frame)

    # Receiving

    async def _next_change(self) -> None:
        if self._stopped:
            raise NodeClosedError(f"{self._node.name} listens to transforms no longer")
        self._changed.clear()
        await self._changed.wait()

    def _received(self, message: Message, *, static: bool) -> None:
        buffer = self._fresh_buffer()
        for transform in message.transforms:
            try:
                buffer.insert(StampedTransform.read(transform), static=static)
            except BadTransformError as error:
                self._complain(transform.child_frame_id, error)
        self._changed.set()

    def _fresh_buffer(self) -> Buffer:
        """Return the buffer, without transforms from before a jump of time."""
        now = self._node.time()
        if now < self._latest - JUMP:
            _log.warning("time jumped back by %.3f s: transforms are forgotten", self._latest - now)
            self.buffer.clear()
            self._latest = now
        self._latest = max(self._latest, now)
        return self.buffer

    def _complain(self, child: str, error: BadTransformError) -> None:
        if child not in self._warned_of and len(self._warned_of) < MAX_WARNINGS:
            self._warned_of.add(child)
            _log.warning("ignored: %s", error)
