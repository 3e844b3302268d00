"""Decides whether a request to one of several masters is sent once more. Pure."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING

from rce_master.leadership.core import STANDBY_HEADER

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

REPEAT_S = 30.0
"""How long a POST whose answer was lost is repeated: another master may have to take the lead."""
LEADER_S = 8.0
"""How long a request waits for a leading master, if a stand-by answers."""
NOT_NOW = (HTTPStatus.BAD_GATEWAY, HTTPStatus.SERVICE_UNAVAILABLE)
"""Statuses of a master that has no leader just now."""


class Attempts:
    """The attempts at one request, each at the next master.

    Args:
        method: Of the request. A GET changes nothing; a POST has a key by which it is done once.
        masters: How many there are.
        clock: Seconds that never go back.

    Attributes:
        is_patient: Whether the next attempt may take its full time: no other master need be asked soon.
    """

    def __init__(self, method: str, masters: int, clock: Callable[[], float]) -> None:
        self._reads = method == "GET"
        self._is_keyed = method == "POST"
        self._masters = self._untried = masters
        self._clock = clock
        self._lost_until: float | None = None
        """Until when a lost answer is asked for; None: none was lost."""
        self._unled_until: float | None = None
        """Until when a leading master is waited for; None: none was missed."""
        self._was_late = False
        """Whether a master was passed over that may only be slow."""
        self.is_patient = masters == 1 or not (self._reads or self._is_keyed)

    def begin(self) -> bool:
        """Begin an attempt; return whether all masters were tried, so that it is time for a pause before."""
        if is_round := self._untried <= 0:
            self._untried = self._masters
        self._untried -= 1
        return is_round

    def answered(self, status: int, headers: Mapping[str, str]) -> bool:
        """Return whether another attempt follows an answer."""
        if self._is_keyed and _may_be_done(status, headers):
            self._note_lost()
        if _is_unled(status, headers, reads=self._reads):
            if self._unled_until is None:
                self._unled_until = self._clock() + LEADER_S
            if self._has_others:
                return True
        return _is_undecided(status, headers) and self._asks_for_lost

    def failed(self, *, sent: bool, late: bool) -> bool:
        """Return whether another attempt follows one without an answer.

        Args:
            sent: Whether some of the request may have arrived: then it may have been done.
            late: Whether there was no answer in time.
        """
        is_harmless = self._reads or not sent
        if self._is_keyed and not is_harmless:
            self._note_lost()
        self._was_late |= late and sent
        if is_harmless and self._has_others:
            return True
        if self._reads and self._was_late and not self.is_patient:
            self.is_patient = True
            return True
        return self._asks_for_lost

    @property
    def _has_others(self) -> bool:
        return self._untried > 0 or (self._unled_until is not None and self._clock() < self._unled_until)

    @property
    def _asks_for_lost(self) -> bool:
        return self._lost_until is not None and self._clock() < self._lost_until

    def _note_lost(self) -> None:
        if self._lost_until is None:
            self._lost_until = self._clock() + REPEAT_S


def _may_be_done(status: int, headers: Mapping[str, str]) -> bool:
    """Return whether a request may have been done that was not answered with its result."""
    if status == HTTPStatus.SERVICE_UNAVAILABLE:  # by a leader that ends; a stand-by does nothing
        return "Retry-After" in headers and STANDBY_HEADER not in headers
    return status == HTTPStatus.BAD_GATEWAY


def _is_unled(status: int, headers: Mapping[str, str], *, reads: bool) -> bool:
    """Return whether a request found no leading master, and did nothing or only reads."""
    if STANDBY_HEADER in headers:
        return True
    is_ending = status == HTTPStatus.SERVICE_UNAVAILABLE and "Retry-After" in headers
    return reads and is_ending


def _is_undecided(status: int, headers: Mapping[str, str]) -> bool:
    """Return whether an answer leaves open if a request was done that was sent before."""
    is_under_way = status == HTTPStatus.CONFLICT and "Retry-After" in headers
    return is_under_way or status in NOT_NOW
