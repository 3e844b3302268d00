"""Asks the manager why processes of the container were killed.

The environment cannot know: the counters of a container's memory are not visible from inside.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import count

from rce_container.environment.messages import Killed

_TIMEOUT_S = 2.0


class Causes:
    """Asks the manager for causes of death.

    Args:
        send: Sends a message to the manager; returns whether one is connected.
    """

    def __init__(self, send: Callable[[Killed], bool]) -> None:
        self._send = send
        self._numbers = count(1)
        self._asked: dict[int, asyncio.Future[str]] = {}

    async def ask(self) -> str:
        """Ask why a process ended by a SIGKILL that the environment did not send.

        Returns:
            The cause as text; empty if it is unknown, or no manager is connected.
        """
        number = next(self._numbers)
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._asked[number] = answer
        try:
            if not self._send(Killed(request=number)):
                return ""
            async with asyncio.timeout(_TIMEOUT_S):
                return await answer
        except TimeoutError:
            return ""
        finally:
            del self._asked[number]

    def answered(self, request: int, cause: str) -> None:
        """Handle the manager's answer."""
        answer = self._asked.get(request)
        if answer is not None and not answer.done():
            answer.set_result(cause)
