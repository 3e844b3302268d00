"""Archives between masters, as the leading one asks for them: it sends them to stand-bys, or fetches them.

The other end is :mod:`rce_master.http.archives`.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING

import aiohttp
from aiohttp import hdrs

from rce.packages import DEFAULT_LIMITS
from rce.tls import CertificateError, explain_to_client
from rce_master.packages.request_key import HEADER, PATH

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rce.tls import Context
    from rce_master.leadership import Fence
    from rce_master.packages.contents import ContentStore
    from rce_master.packages.request_key import RequestKey
    from rce_master.store.etcd.layout import OtherMaster

CONNECT_S = 2.0
ANSWER_S = 15.0
"""How long a stand-by may take for an answer, beside the transfer."""
MIN_RATE = 1 << 20
"""Bytes per second of a transfer, at least."""


class TransferError(Exception):
    """Another master did not do what it was asked for; the text says why."""


class ArchiveClient:
    """Asks other masters about archives, as the leader of one term.

    Args:
        session: Makes the connections.
        key: Proves that this is a master.
        fence: Of the leadership; nothing is sent after its end.
        tls: Gives the TLS context of each connection to a master that uses TLS.
        path: Where they have them.
    """

    def __init__(
        self,
        session: aiohttp.ClientSession,
        key: RequestKey,
        fence: Fence,
        tls: Context | None = None,
        path: str = PATH,
    ) -> None:
        self._path = path
        self._session = session
        self._key = key
        self._fence = fence
        self._tls = tls

    async def held(self, master: OtherMaster) -> set[str]:
        """Return the hashes of the archives that a master has.

        Raises:
            TransferError: It does not say.
            FencedError: This master leads no more.
        """
        async with self._ask(master, hdrs.METH_GET, self._path) as reply:
            return set((await reply.text()).split())

    async def send(self, master: OtherMaster, sha256: str, store: ContentStore) -> None:
        """Send an archive; when this returns, the other master has it on its disk, and has checked its hash.

        Raises:
            TransferError: It was not taken.
            FencedError: This master leads no more.
        """
        path = store.path(sha256)
        try:
            size = (await asyncio.to_thread(path.stat)).st_size
            file = await asyncio.to_thread(path.open, "rb")
        except OSError as error:
            raise TransferError(f"this master cannot read the archive: {error.strerror}") from error
        with file:
            async with self._ask(master, hdrs.METH_PUT, f"{self._path}/{sha256}", size, data=file):
                pass

    async def fetch(self, master: OtherMaster, sha256: str, store: ContentStore) -> None:
        """Fetch an archive, and keep it after its hash was checked.

        Raises:
            TransferError: The other master does not give it.
            StoreError: It cannot be kept.
            FencedError: This master leads no more.
        """
        async with (
            self._ask(master, hdrs.METH_GET, f"{self._path}/{sha256}", DEFAULT_LIMITS.archive) as reply,
            store.receive(reply.content.iter_any()) as incoming,
        ):
            if incoming.sha256 != sha256:
                raise TransferError(f"{master.name}: its archive is damaged")
            await store.keep(incoming)

    async def remove(self, master: OtherMaster, sha256: str) -> None:
        """Let another master remove an archive.

        Raises:
            TransferError: It did not.
            FencedError: This master leads no more.
        """
        async with self._ask(master, hdrs.METH_DELETE, f"{self._path}/{sha256}"):
            pass

    @asynccontextmanager
    async def _ask(
        self, master: OtherMaster, method: str, path: str, size: int = 0, data: object = None
    ) -> AsyncIterator[aiohttp.ClientResponse]:
        """Send a request, and give its answer if that is a success.

        Args:
            master: Whom to ask.
            method: Of HTTP.
            path: What to ask for.
            size: Bytes that are transferred, at most.
            data: The body.
        """
        self._fence.check()
        try:
            async with (
                asyncio.timeout(CONNECT_S + ANSWER_S + size / MIN_RATE),
                self._session.request(
                    method,
                    master.url.rstrip("/") + path,
                    headers={HEADER: self._key.sign(method, path, self._fence.term)},
                    data=data,
                    allow_redirects=False,
                    ssl=self._tls() if self._tls is not None else True,
                ) as reply,
            ):
                if reply.status not in (HTTPStatus.OK, HTTPStatus.NO_CONTENT):
                    text = (await reply.content.read(300)).decode(errors="replace")
                    raise TransferError(f"{master.name}: answered {reply.status}: {text}")
                yield reply
        except (aiohttp.ClientError, OSError, CertificateError) as error:  # a time-out is an OSError
            why = explain_to_client(error) or str(error) or "no answer in time"
            raise TransferError(f"{master.name}: {why}") from error
