"""Learns types from nodes, of which some may not answer."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from rce.aio.tasks import TaskScope
from rce.ros.multimaster.errors import NothingToRelayError

_log = logging.getLogger(__name__)

K = TypeVar("K")

PROMPT = 0.5
"""Seconds to wait for answers; later ones are taken the next time."""

MAX_PROBES = 128
"""Topics or services whose types are asked for at the same time."""


@dataclass(frozen=True, slots=True)
class Question(Generic[K]):
    """Asks for the type of one topic or service."""

    origins: frozenset[str]
    """The URIs of those who are asked; when they change, an answer does not count any longer."""
    ask: Callable[[], Awaitable[K]]
    """Raises :class:`NothingToRelayError` if they do not tell."""
    type_name: str = ""
    """A topic's type as the master names it."""

    def is_same(self, other: Question[K]) -> bool:
        """Return whether the same is asked of the same nodes."""
        return (self.origins, self.type_name) == (other.origins, other.type_name)


class Learning(Generic[K]):
    """Asks for many types at once: a host that is away takes seconds to fail, and delays no other.

    Args:
        tasks: Owns the tasks that ask.
    """

    def __init__(self, tasks: TaskScope) -> None:
        self._tasks = tasks
        self._turns = asyncio.Semaphore(MAX_PROBES)
        self._asking: dict[str, tuple[Question[K], asyncio.Task[K | None]]] = {}

    async def learn(self, questions: Mapping[str, Question[K]]) -> dict[str, tuple[Question[K], K]]:
        """Ask, and return the answers that are there within :data:`PROMPT` seconds.

        Args:
            questions: By name, all that are open; the former ones continue, those that are left out end.
        """
        for name, (question, task) in list(self._asking.items()):
            if name not in questions or not question.is_same(questions[name]):
                task.cancel()
                del self._asking[name]
        for name, question in questions.items():
            if name not in self._asking:
                task = self._tasks.spawn(self._ask(question), name=f"learn the type of {name}")
                self._asking[name] = question, task
        if self._asking:
            await asyncio.wait([task for _, task in self._asking.values()], timeout=PROMPT)
        found: dict[str, tuple[Question[K], K]] = {}
        for name, (question, task) in list(self._asking.items()):
            if task.done():
                del self._asking[name]
                if not task.cancelled() and (answer := task.result()) is not None:
                    found[name] = question, answer
        return found

    def close(self) -> None:
        """Ask no more."""
        for _, task in self._asking.values():
            task.cancel()
        self._asking.clear()

    async def _ask(self, question: Question[K]) -> K | None:
        try:
            async with self._turns:
                return await question.ask()
        except NothingToRelayError as error:
            _log.debug("%s", error)
            return None
