"""The tasks around volumes: removal on request, and measuring."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

from rce.control import ToMaster, VolumeRemoved

if TYPE_CHECKING:
    from rce_container.runtimes.base import Handle
    from rce_container.volumes.store import VolumeStore

_ROUNDS = 5
"""Volumes are measured once in so many intervals of the usage: folders are slow to measure."""


class Subject(Protocol):
    """A running container, as far as its volumes are concerned."""

    @property
    def handle(self) -> Handle:
        """Its outermost process."""

    def stop_over_limit(self, text: str) -> None:
        """End it, because a volume of it is too full."""


class VolumeKeeper:
    """Removes volumes when their containers have ended, and ends containers whose volumes are too full.

    Args:
        store: The volumes.
        send: Sends a message to the master.
        spawn: Runs a task as long as the manager runs.
    """

    def __init__(
        self,
        store: VolumeStore,
        send: Callable[[ToMaster], None],
        spawn: Callable[..., object],
    ) -> None:
        self._store = store
        self._send = send
        self._spawn = spawn

    def remove(self, id_: str) -> None:
        """Remove a volume, now or when its container has ended; tell the master when it is gone."""
        if self._store.doom(id_):
            self._spawn(self._delete(id_), name=f"removal of volume {id_}")

    def release(self, incarnation_id: str) -> None:
        """Take the volumes of a container that has ended."""
        for id_ in self._store.release(incarnation_id):
            self._spawn(self._delete(id_), name=f"removal of volume {id_}")

    async def _delete(self, id_: str) -> None:
        await asyncio.to_thread(self._store.places.delete_removed)
        self._send(VolumeRemoved(volume=id_))

    async def run(self, subjects: Mapping[str, Subject], interval: float) -> None:
        """Delete what an earlier manager left of removed volumes, then measure volumes until cancelled.

        Args:
            subjects: The running containers, by incarnation.
            interval: Seconds between two reports of the usage.
        """
        await asyncio.to_thread(self._store.places.delete_removed)
        while True:
            pids = {id_: subject.handle.namespaces_pid for id_, subject in subjects.items()}
            for incarnation_id, text in await asyncio.to_thread(self._store.measure, pids):
                if (subject := subjects.get(incarnation_id)) is not None:
                    subject.stop_over_limit(text)
            await asyncio.sleep(_ROUNDS * interval)
