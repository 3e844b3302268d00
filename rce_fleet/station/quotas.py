"""What one user may ask of a station: requests in a second, streams of events and pages at the same time.

Users share the station's event loop, and the fleet manager behind it: one of them must not take it from the
others. Requests are counted as the engine counts them, not for administrators. An emergency stop is
never counted.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from rce.guard import NoPlaceError, Places, Rates

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.station.authentication import StationUser

REQUESTS_PER_S = 100.0
REQUEST_BURST = 2000
"""After a pause: an ERP that begins its day, or an operator who blocks the cells of a hall."""
STREAMS_EACH, MAX_STREAMS = 50, 500
"""Open streams of events, and histories that are being sent as CSV: of a user, and of all at one station."""
PAGES_EACH, MAX_PAGES = 50, 250
"""Open pages. At a station without logins all of them are one user's."""
REQUESTS_PER_PAGE = 8.0
"""What an open page may ask for in a second beside that: it reads the manager every two seconds."""


class StationQuotas:
    """Counts what users ask for.

    Args:
        requests: Requests of one user in a second, on average.
        burst: The same after a pause.
        clock: Seconds that never go back.

    Attributes:
        streams: Places of streams of events.
        pages: Places of pages.
    """

    def __init__(
        self,
        requests: float = REQUESTS_PER_S,
        burst: int = REQUEST_BURST,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._rates = Rates(per_second=requests, burst=burst)
        self._requests = requests
        self._clock = clock
        self.streams = Places(each=STREAMS_EACH, most=MAX_STREAMS)
        self.pages = Places(each=PAGES_EACH, most=MAX_PAGES)

    def request(self, user: StationUser) -> int:
        """Count a request; return the seconds after which to ask again, 0: it is allowed."""
        if user.role == "admin":
            return 0
        # With pages, each request takes a smaller part of the same bucket.
        share = self._requests / (self._requests + REQUESTS_PER_PAGE * self.pages.of(user.name))
        return math.ceil(self._rates.take(user.name, self._clock(), share))


def why_no_place(what: str, error: NoPlaceError) -> str:
    """Return for people why something cannot be opened.

    Args:
        what: Such as ``pages``.
        error: Which places are taken.
    """
    whose = "you have" if error.is_own else "the station's users have"
    return f"{whose} {error.most} {what} open, and may not have more; close some"
