"""The running uploads of archives: one per user, with a total limit that slow uploads cannot exhaust."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce_master.exceptions import BusyError, TooMuchError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

UPLOAD_S = 1800.0
"""Maximum duration of an upload."""
MAX_UPLOADS = 64
"""Maximum number of uploads at the same time; one per user."""
FIRST_S = 10.0
"""Minimum age at which an upload may be replaced by a new one."""


@dataclass(eq=False, slots=True)
class Upload:
    """A running upload."""

    user: str
    begun: float
    deadline: asyncio.Timeout
    received: int = 0
    """Bytes."""
    gave_way: bool = field(default=False)

    async def counted(self, chunks: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """Pass on the received data, and count it."""
        async for chunk in chunks:
            self.received += len(chunk)
            yield chunk

    def rate(self, now: float) -> float:
        """Return the received bytes per second."""
        return self.received / (now - self.begun)


class Uploads:
    """The running uploads. If there are too many, a new one replaces the slowest.

    Args:
        clock: Seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._uploads: dict[str, Upload] = {}
        """By user."""

    @contextlib.asynccontextmanager
    async def one(self, user: str) -> AsyncIterator[Upload]:
        """Hold a place as long as the context lasts.

        Raises:
            TooMuchError: The user has another running upload.
            BusyError: All places are taken, or the upload took too long, or another one replaced it.
        """
        if user in self._uploads:
            raise TooMuchError("you are pushing another package just now; try again when it is done", 5)
        if len(self._uploads) >= MAX_UPLOADS:
            self._make_room()
        upload: Upload | None = None
        try:
            async with asyncio.timeout(UPLOAD_S) as deadline:
                upload = self._uploads[user] = Upload(user, self._clock(), deadline)
                yield upload
        except TimeoutError:
            if upload is not None and upload.gave_way:
                raise BusyError(
                    "the archive came too slowly and gave way to others; try again later"
                ) from None
            raise BusyError(f"the archive did not come in within {UPLOAD_S:.0f} s") from None
        finally:
            if upload is not None and self._uploads.get(user) is upload:
                del self._uploads[user]

    def _make_room(self) -> None:
        now = self._clock()
        older = [one for one in self._uploads.values() if now - one.begun >= FIRST_S]
        if not older:
            raise BusyError("too many packages are pushed at the same time; try again in a moment")
        slowest = min(older, key=lambda one: one.rate(now))
        slowest.gave_way = True
        slowest.deadline.reschedule(asyncio.get_running_loop().time())
        del self._uploads[slowest.user]
