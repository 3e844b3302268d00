"""Tells operators what the number of etcd's members lacks, without that they ask."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rce_master.cluster.members import advice
from rce_master.exceptions import StoreError

if TYPE_CHECKING:
    from rce_master.cluster.client import ClusterClient

_log = logging.getLogger(__name__)

LOOK_S = 60.0
"""From one look to the next: members join and leave while masters run."""


class MemberAdvice:
    """Looks at the members of etcd, and logs what their number lacks each time that it changes.

    Args:
        client: Connected to etcd.

    Attributes:
        text: What it lacks; empty if nothing, or if etcd has not told yet.
    """

    def __init__(self, client: ClusterClient) -> None:
        self._client = client
        self.text = ""

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            try:
                self._note(advice(await self._client.members()))
            except StoreError as error:
                _log.debug("the members of etcd are not known: %s", error)
            await asyncio.sleep(LOOK_S)

    def _note(self, text: str) -> None:
        if text and text != self.text:
            _log.warning("members of etcd: %s", text)
        self.text = text
