"""The audit logs of the other masters: each has the records of the terms in which it led."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec
from aiohttp import hdrs

from rce_master.audit import Record
from rce_master.exceptions import StoreError
from rce_master.leadership.standby_client import StandbyError

if TYPE_CHECKING:
    from rce_master.leadership.registry import MasterRegistry
    from rce_master.leadership.standby_client import StandbyClient
    from rce_master.store.etcd.layout import OtherMaster

PATH = "/audit"
"""Where a stand-by gives its records (:mod:`rce_master.http.audit_route`)."""
ANSWER_S = 3.0


class OtherAudits:
    """Asks the other masters for their records.

    Args:
        registry: Knows them.
        client: Sends the requests.
    """

    def __init__(self, registry: MasterRegistry, client: StandbyClient) -> None:
        self._registry = registry
        self._client = client

    async def since(self, id_: int, limit: int, user: str) -> tuple[list[Record], list[str]]:
        """List what each of them has, as :func:`rce_master.audit.choose` does.

        Returns:
            The records, in no order, and for each master that gave none: why.

        Raises:
            FencedError: This master leads no more.
        """
        try:
            others = await self._registry.others()
        except StoreError as error:
            return [], [f"the other masters are not known now: {error}"]
        query = {"since": str(id_), "limit": str(limit), "user": user}
        answers = await asyncio.gather(*(self._ask(other, query) for other in others))
        return (
            [record for records, _ in answers for record in records],
            [why for _, why in answers if why],
        )

    async def _ask(self, master: OtherMaster, query: dict[str, str]) -> tuple[list[Record], str]:
        try:
            async with self._client.ask(master, hdrs.METH_GET, PATH, query=query, answer_s=ANSWER_S) as reply:
                return msgspec.json.decode(await reply.read(), type=list[Record]), ""
        except StandbyError as error:
            return [], str(error)
        except msgspec.MsgspecError as error:
            return [], f"{master.name}: its records are not readable: {error}"
