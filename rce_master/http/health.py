"""``GET /healthz``: whether the master works. Public; concurrent requests share one check of the store."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from aiohttp import hdrs, web

from rce import __version__
from rce_master.exceptions import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rce_master.leadership import Fence
    from rce_master.leadership.drains import MasterDrains
    from rce_master.state_service import StateService


HEALTH_PATH: Final = "/healthz"
CHECK_S = 1.0
"""How long a request waits for the store; the programs that ask give up after 2 s."""
AGAIN: Final[dict[str, str]] = {hdrs.RETRY_AFTER: "1"}
"""Headers of a stand-by's answer: whether it leads may change within a second."""


class Health:
    """Reports whether the store is usable, and how many task sets are connected.

    Args:
        state_service: The owner of the store.
        fence: Of this master's leadership, if there may be other masters; then the answer says that it leads.
        drains: Tells whether this master is drained, if there may be others.
        warnings: What is added to the status while the master works; empty texts are left out.
    """

    def __init__(
        self,
        state_service: StateService,
        fence: Fence | None = None,
        drains: MasterDrains | None = None,
        warnings: Iterable[Callable[[], str]] = (),
    ) -> None:
        self._state_service = state_service
        self._fence = fence
        self._drains = drains
        self._warnings = tuple(warnings)
        self._look: asyncio.Task[str] | None = None
        """The running check; concurrent requests wait for its result."""

    async def handle(self, _: web.Request) -> web.Response:
        """Answer 200, or 503 with the fault."""
        fault = "" if self._is_fenced else await self._fault()
        if self._fence is not None and self._is_fenced:
            return web.json_response(self._fenced(self._fence), status=503, headers=AGAIN)
        tables = self._state_service.tables
        connected = sum(tables.is_connected(task_set.process) for task_set in tables.task_sets)
        status = fault or with_warnings("ok", self._warnings)
        body: dict[str, object] = {"status": status, "task_sets": connected}
        if self._fence is not None:
            term, name, drained = self._fence.term, self._fence.name, self._is_drained
            body |= describe_role("leader", term, name, ready=not fault, drained=drained)
        return web.json_response(body, status=503 if fault else 200)

    def _fenced(self, fence: Fence) -> dict[str, object]:
        """Answer as the stand-by that this master is about to be."""
        role = describe_role("standby", fence.term, "", ready=False, drained=self._is_drained)
        return {"status": "stand-by; this master led until now", **role}

    @property
    def _is_drained(self) -> bool:
        return self._drains is not None and self._drains.is_drained

    @property
    def _is_fenced(self) -> bool:
        return self._fence is not None and self._fence.is_closed

    async def _fault(self) -> str:
        """Return the fault of the store; empty if it works."""
        look = self._look
        if look is None:
            look = self._look = asyncio.create_task(self._check())
        done, _ = await asyncio.wait([look], timeout=CHECK_S)
        return look.result() if done else f"the store has not answered within {CHECK_S:.3g} s"

    async def _check(self) -> str:
        try:
            await self._state_service.check_store()
        except StoreError as error:
            return str(error)
        finally:
            self._look = None
        return ""


def with_warnings(status: str, warnings: Iterable[Callable[[], str]]) -> str:
    """Return a status with what an operator has to know beside it."""
    return "; ".join([status, *filter(None, (warning() for warning in warnings))])


def describe_role(role: str, term: int, leader: str, *, ready: bool, drained: bool) -> dict[str, object]:
    """Return the part of an answer that tells which master leads.

    Args:
        role: ``leader`` or ``standby``.
        term: The newest term that this master knows; 0: none.
        leader: The name of the leading master; empty: none, or unknown.
        ready: Whether this master serves clients.
        drained: Whether it leads only if no other one does.
    """
    return {
        "live": True,
        "ready": ready,
        "role": role,
        "term": term,
        "leader": leader,
        "drained": drained,
        "version": __version__,
    }
