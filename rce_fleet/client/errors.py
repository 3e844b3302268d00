"""Errors of the fleet's client.

::

    StationError
    +-- FleetApiUnavailableError   station or fleet manager cannot be reached; it may have been done
    +-- ApiError                   the request was refused
        +-- NotFoundError          there is no such task, robot or zone (404)
        +-- OutdatedError          the thing was changed meanwhile: read it again (412)
"""

from __future__ import annotations

from http import HTTPStatus

from rce_fleet.exceptions import StationError


class FleetApiUnavailableError(StationError):
    """Station or fleet manager cannot be reached, also after several attempts."""


class ApiError(StationError):
    """The request was refused.

    Attributes:
        status: The HTTP status.
        reason: What is wrong, and how to correct it.
    """

    def __init__(self, status: int, reason: str) -> None:
        self.status = status
        self.reason = reason
        super().__init__(status, reason)

    def __str__(self) -> str:
        return self.reason


class NotFoundError(ApiError):
    """There is no such task, robot or zone."""


class OutdatedError(ApiError):
    """The thing was changed after the revision that the request names."""


def error_of(status: int, reason: str) -> ApiError:
    """Return the error of an answer."""
    kinds: dict[int, type[ApiError]] = {
        HTTPStatus.NOT_FOUND: NotFoundError,
        HTTPStatus.PRECONDITION_FAILED: OutdatedError,
    }
    return kinds.get(status, ApiError)(status, reason)
