"""Archives between masters, as the leading one asks for them: it sends them to stand-bys, or fetches them.

The other end is :mod:`rce_master.http.archives`.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aiohttp import ClientError, hdrs

from rce.packages import DEFAULT_LIMITS
from rce.web.sending import watched_body
from rce_master.leadership.standby_client import ANSWER_S, MIN_RATE, StandbyError, failure

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aiohttp import ClientResponse

    from rce_master.leadership.standby_client import StandbyClient
    from rce_master.packages.contents import ContentStore
    from rce_master.store.etcd.layout import OtherMaster

STALL_S = 10.0
"""How long a master that takes an archive may take none of it; it writes to its disk meanwhile."""
SILENCE_S = 5.0
"""How long a master that gives an archive may be silent, before and within its answer."""
REMOVAL_S = 3.0
"""How long a removal may take; a push of the same archive waits for it."""


class ArchiveClient:
    """Asks other masters about archives.

    Args:
        client: Sends the requests.
        path: Where they have the archives.
    """

    def __init__(self, client: StandbyClient, path: str) -> None:
        self._client = client
        self._path = path

    async def held(self, master: OtherMaster, *, answer_s: float = ANSWER_S) -> set[str]:
        """Return the hashes of the archives that a master has.

        Args:
            master: Whom to ask.
            answer_s: Seconds that it may take.

        Raises:
            StandbyError: It does not say.
            FencedError: This master leads no more.
        """
        async with self._client.ask(master, hdrs.METH_GET, self._path, answer_s=answer_s) as reply:
            return set((await reply.text()).split())

    async def send(self, master: OtherMaster, sha256: str, store: ContentStore) -> None:
        """Send an archive; when this returns, the other master has it on its disk, and has checked its hash.

        Raises:
            StandbyError: It was not taken.
            FencedError: This master leads no more.
        """
        path = store.path(sha256)
        try:
            size = (await asyncio.to_thread(path.stat)).st_size
            file = await asyncio.to_thread(path.open, "rb")
        except OSError as error:
            raise StandbyError(f"this master cannot read the archive: {error.strerror}") from error
        url = f"{self._path}/{sha256}"
        try:
            with file:
                async with (
                    watched_body(file, stall_s=STALL_S, answer_s=ANSWER_S + size / MIN_RATE) as body,
                    self._client.ask(master, hdrs.METH_PUT, url, size=size, data=body),
                ):
                    pass
        except TimeoutError as error:
            raise failure(master, error) from error

    async def fetch(self, master: OtherMaster, sha256: str, store: ContentStore) -> None:
        """Fetch an archive, and keep it after its hash was checked.

        Raises:
            StandbyError: The other master does not give it.
            StoreError: It cannot be kept.
            FencedError: This master leads no more.
        """
        async with (
            self._client.ask(
                master,
                hdrs.METH_GET,
                f"{self._path}/{sha256}",
                size=DEFAULT_LIMITS.archive,
                silence_s=SILENCE_S,
            ) as reply,
            store.receive(_pieces(master, reply)) as incoming,
        ):
            if incoming.sha256 != sha256:
                raise StandbyError(f"{master.name}: its archive is damaged")
            await store.keep(incoming)

    async def remove(self, master: OtherMaster, sha256: str) -> None:
        """Let another master remove an archive.

        Raises:
            StandbyError: It did not.
            FencedError: This master leads no more.
        """
        path = f"{self._path}/{sha256}"
        async with self._client.ask(master, hdrs.METH_DELETE, path, answer_s=REMOVAL_S):
            pass


async def _pieces(master: OtherMaster, reply: ClientResponse) -> AsyncIterator[bytes]:
    """Yield an archive; errors of the connection are told from those of this master's disk.

    Raises:
        StandbyError: The connection failed, or the other master was silent for too long.
    """
    try:
        async for piece in reply.content.iter_any():
            yield piece
    except (ClientError, OSError) as error:
        raise failure(master, error) from error
