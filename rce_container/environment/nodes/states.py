"""Keeps the states of nodes: each life gets the newest snapshot at first, then snapshots are made of it.

A life that did not get its snapshot is not saved: what it would save replaced the snapshot.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from typing import TYPE_CHECKING, Protocol

from rce.aio.backoff import Backoff
from rce.model import MAX_STATE, MEGABYTE, NodeSpec
from rce.ros import names
from rce_container.environment.exceptions import NodeStateError
from rce_container.environment.graph import Graph, GraphError
from rce_container.environment.nodes.events import Event, Restored, Unsaved
from rce_container.environment.nodes.launch import ros_name_of

if TYPE_CHECKING:
    from collections.abc import Callable

SERVICE_WITHIN_S = 60.0
"""Seconds from the start of a node within which its service for restoring has to answer."""
CALL_S = 15.0
"""Seconds that a node may take to save or restore its state."""
RETRY = Backoff(first=0.2, longest=5.0)
"""Delays before a snapshot that could not be fetched is asked for again."""
TOLD_AFTER_S = 10.0
"""Seconds without a kept snapshot until that is told: another master may take the lead meanwhile."""
REPEAT_S = 300.0
"""Seconds after which an equal snapshot is sent again: the master may have lost the one before."""


class Vault(Protocol):
    """Where snapshots are kept, outside the container."""

    async def fetch(self, node: str) -> bytes | None:
        """Return the newest snapshot of a node; None if there is none.

        Raises:
            NodeStateError: It cannot be told now.
        """

    async def keep(self, node: str, state: bytes) -> None:
        """Keep a snapshot; when this returns, it is acknowledged.

        Raises:
            NodeStateError: It is not kept, or that is not known.
        """


class NodeStates:
    """The states of all nodes of a container.

    Args:
        graph: The container's graph.
        vault: Keeps snapshots.
    """

    def __init__(self, graph: Graph, vault: Vault) -> None:
        self._graph = graph
        self._vault = vault
        self._savers: dict[str, _Saver] = {}
        """Of the lives that are saved, by the nodes' tags."""

    async def keep(self, spec: NodeSpec, life: int, feed: Callable[[Event], None]) -> None:
        """Restore a life of a node, then save it regularly, until cancelled.

        Returns at once if the node's state is not kept, or was not restored.

        Args:
            spec: The node.
            life: The life's number.
            feed: Takes the events.
        """
        services = spec.state_services
        if services is None:
            return
        state = await self._fetch(spec.tag, life, feed)
        fault = "" if state is None else await self._restore(_global(spec, services.restore), state)
        feed(Restored(spec.tag, life, fault))
        if fault:
            return
        service = _global(spec, services.save)
        saver = self._savers[spec.tag] = _Saver(
            self._graph,
            self._vault,
            spec.tag,
            service,
            lambda text: feed(Unsaved(spec.tag, life, text)),
        )
        try:
            with contextlib.suppress(GraphError):  # the first save tells it
                await self._graph.wait_for_service(service, SERVICE_WITHIN_S)
            pauses, pause = RETRY.start(), services.every
            while True:
                await asyncio.sleep(pause)
                is_saved = not await saver.save()
                pause = services.every if is_saved else min(services.every, pauses.next())
                if is_saved:
                    pauses.reset()
        finally:
            if self._savers.get(spec.tag) is saver:
                del self._savers[spec.tag]

    async def save_now(self, tag: str) -> str:
        """Save a node's state at once, also if it has not changed.

        Returns:
            Why it is not saved; empty if it is.
        """
        saver = self._savers.get(tag)
        if saver is None:
            return f"node {tag} does not run, or its state was not restored"
        return await saver.save(again=True)

    async def _fetch(self, tag: str, life: int, feed: Callable[[Event], None]) -> bytes | None:
        pauses = RETRY.start()
        while True:
            try:
                return await self._vault.fetch(tag)
            except NodeStateError as error:
                feed(Unsaved(tag, life, f"its state is not there yet: {error}; it is tried again"))
                await asyncio.sleep(pauses.next())

    async def _restore(self, service: str, state: bytes) -> str:
        """Give a node its state; return why it did not take it."""
        try:
            await self._graph.wait_for_service(service, SERVICE_WITHIN_S)
            await self._graph.restore_state(service, state, CALL_S)
        except GraphError as error:
            return str(error)
        return ""


class _Saver:
    """Makes snapshots of one life of a node, one at a time; equal ones are rarely sent again."""

    def __init__(
        self, graph: Graph, vault: Vault, tag: str, service: str, tell: Callable[[str], None]
    ) -> None:
        self._graph = graph
        self._vault = vault
        self._tag = tag
        self._service = service
        self._tell = tell
        self._lock = asyncio.Lock()
        self._kept = b""
        """Hash of the last snapshot that was acknowledged; empty while it is not known which one counts."""
        self._kept_at = 0.0
        self._failing_since: float | None = None

    async def save(self, *, again: bool = False) -> str:
        """Make a snapshot; return why there is none.

        Args:
            again: Whether it is sent also if it is equal to the one before.
        """
        async with self._lock:
            now = asyncio.get_running_loop().time()
            try:
                await self._save(again=again or now - self._kept_at >= REPEAT_S)
            except GraphError as error:
                text = f"its state is not saved: {error}"
            except NodeStateError as error:
                text = f"its state is not saved: {error}"
                self._failing_since = now if self._failing_since is None else self._failing_since
                if now - self._failing_since < TOLD_AFTER_S:
                    return text
            else:
                text, self._failing_since = "", None
            self._tell(text)
            return text

    async def _save(self, *, again: bool) -> None:
        state = await self._graph.save_state(self._service, CALL_S)
        if len(state) > MAX_STATE:
            raise GraphError(f"it is larger than {MAX_STATE // MEGABYTE} MB, which is the most")
        digest = await asyncio.to_thread(lambda: hashlib.sha256(state).digest())
        if again or digest != self._kept:
            self._kept = b""  # if the answer is lost, this one may count as well as the one before
            await self._vault.keep(self._tag, state)
            self._kept, self._kept_at = digest, asyncio.get_running_loop().time()


def _global(spec: NodeSpec, name: str) -> str:
    """Return the global name of a service of a node, which may be relative or private to the node."""
    return names.resolve(name, ros_name_of(spec))
