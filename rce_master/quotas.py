"""Quotas of one user's requests, streams and reads of logs.

Usage is counted per user, so that one user does not affect another. Quotas do not apply to administrators;
only their lists are made one after the other, too.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce.guard import CrowdedError, NoPlaceError, Places, Rates, Turns
from rce_master.exceptions import TooMuchError
from rce_master.state.user_records import User, UserRole

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator


READS_AT_ONCE = 32
READS_WAITING = 512
"""Waiting reads of logs of all users; beyond it, the user with the most is told to try later."""
LISTS_AT_ONCE = 4
"""Lists that are made for all users at the same time, one of each user: a long one counts as one request, and
between two turns of the event loop a piece of each is made."""
LISTS_WAITING = 2048
"""Waiting lists of all users; beyond it, the user with the most is told to try later."""
REPLAY_BURST = 200
"""Parts of past events that a user's streams send without a pause: twice all events that are kept."""
ITEMS_PER_REQUEST = 20
"""How many nodes, interfaces, parameters, ... in one request count as one more request."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QuotaSettings:
    """The quotas of one user."""

    requests: float = 100.0
    """Requests over REST each second, and as many over all WebSockets of their robots, and as many logins of
    robots; 0 for no limit."""
    request_burst: int = 2000
    """The burst of requests after a pause."""
    streams: int = 64
    """Streams of events and of usage at the same time; 0 for no limit."""
    log_reads: int = 4
    """Reads of logs at the same time; others wait for them."""


class Quotas:
    """Counts the requests of users.

    Args:
        settings: The quotas of one user.
        clock: Seconds that never go back.
    """

    def __init__(
        self, settings: QuotaSettings | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._settings = settings or QuotaSettings()
        self._clock = clock
        burst = self._settings.request_burst
        self._rest, self._robots, self._logins = (self._rates(burst) for _ in range(3))
        self._replays = self._rates(min(burst, REPLAY_BURST))
        self._streams = Places(each=self._settings.streams)
        self._reads = Turns(READS_AT_ONCE, waiting=READS_WAITING, each=self._settings.log_reads)
        self._lists = Turns(LISTS_AT_ONCE, waiting=LISTS_WAITING, each=1)

    def request(self, user: User) -> None:
        """Count a request over REST.

        Raises:
            TooMuchError: There were too many requests.
        """
        self._take(self._rest, user, 1)

    def robot_request(self, user: User, items: int) -> None:
        """Count a request of a robot.

        Args:
            user: The robot's user.
            items: How many nodes, interfaces, ... it contains.

        Raises:
            TooMuchError: There were too many requests.
        """
        self._take(self._robots, user, 1 + items // ITEMS_PER_REQUEST)

    def robot_login(self, user: User) -> None:
        """Count a login of a robot.

        Raises:
            TooMuchError: There were too many logins.
        """
        self._take(self._logins, user, 1, "logins of robots")

    async def replay(self, user: User) -> None:
        """Count a part of the events of the past that a stream sends; wait if a user's streams sent many.

        Does not count as a request, so that following events leaves all requests to the user.
        """
        if self._replays is not None and user.role is not UserRole.ADMIN:
            await asyncio.sleep(self._replays.reserve(user.name, self._clock()))

    @contextlib.contextmanager
    def stream(self, user: User) -> Iterator[None]:
        """Count a stream as long as the context lasts.

        Raises:
            TooMuchError: There are too many streams.
        """
        if user.role is UserRole.ADMIN:
            yield
            return
        with contextlib.ExitStack() as place:
            try:
                place.enter_context(self._streams.place(user.name))
            except NoPlaceError as error:
                raise TooMuchError(
                    f"you follow {error.most} streams of events or usage already, and may not follow more;"
                    " end one",
                    1,
                ) from None
            yield

    @contextlib.asynccontextmanager
    async def log_read(self, user: User) -> AsyncIterator[None]:
        """Wait until a user may read a log.

        Raises:
            TooMuchError: Too many of the user's reads wait.
        """
        async with _turn(self._reads, user, "reads of logs"):
            yield

    @contextlib.asynccontextmanager
    async def making_list(self, user: User) -> AsyncIterator[None]:
        """Wait until a list, or a page of one, may be made for a user; administrators wait for theirs, too.

        Raises:
            TooMuchError: Too many of the user's lists wait.
        """
        async with _turn(self._lists, user, "lists"):
            yield

    def _rates(self, burst: int) -> Rates | None:
        if not self._settings.requests:
            return None
        return Rates(per_second=self._settings.requests, burst=max(1, burst))

    def _take(self, rates: Rates | None, user: User, cost: int, what: str = "requests") -> None:
        if rates is None or user.role is UserRole.ADMIN:
            return
        wait = rates.take(user.name, self._clock(), cost)
        if wait:
            raise TooMuchError(
                f"too many {what}: you may make {self._settings.requests:g} a second; "
                f"try again in {math.ceil(wait)} s",
                wait,
            )


@contextlib.asynccontextmanager
async def _turn(turns: Turns, user: User, what: str) -> AsyncIterator[None]:
    turn = turns.turn(user.name)
    try:
        await turn.__aenter__()
    except CrowdedError:
        raise TooMuchError(f"too many of your {what} wait already; read one after the other", 1) from None
    try:
        yield
    finally:
        await turn.__aexit__(None, None, None)
