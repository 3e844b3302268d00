"""What can go wrong in the master.

::

    MasterError
    +-- Refused                 a request was not done; the text says what was wrong and how to mend it
    |   +-- Invalid             it can never be done like this
    |   +-- NotFound            it names something that is not there
    |   +-- Conflict            it contradicts what is there
    |   +-- LimitReached        there are too many already
    |   +-- NoRoom              no machine, or not its own, has enough of what a container asks for
    |   +-- Forbidden           this user may not do it
    |   +-- Busy                too much of the kind is done just now
    |   +-- TooMuch             this user asks too much at a time; wait
    +-- AuthError
    |   +-- WrongCredentials    unknown user, wrong password, unknown or expired token
    |   +-- TooManyFailures     too many wrong passwords; wait
    |   +-- TooManyLogins       too many people log in just now; wait
    +-- TransitionError         an event that a life cycle does not allow in the present state
    +-- StoreError              the store cannot be read or written
    |   +-- StoreBusy           another process owns the state folder
    +-- TaskSetAway             the task set that is to be asked is not there
"""

from __future__ import annotations

import math

from rce.lifecycle import InvalidTransitionError


class MasterError(Exception):
    """Base of all errors of the master."""


class Refused(MasterError):  # noqa: N818
    """A request was not done and nothing was changed by it.

    Attributes:
        status: The HTTP status that tells the same.
    """

    status = 400


class Invalid(Refused):
    """The request can never be done like this."""

    status = 422


class NotFound(Refused):
    """The request names something that is not there."""

    status = 404


class Conflict(Refused):
    """The request contradicts what is there."""

    status = 409


class LimitReached(Refused):
    """There are too many of the kind already."""

    status = 409


class NoRoom(Refused):
    """No machine, or not its own, has enough of what a container asks for."""

    status = 409


class Forbidden(Refused):
    """The user may not do it."""

    status = 403


class Busy(Refused):
    """Too much of the kind is done just now."""

    status = 503


class TooMuch(Refused):
    """A user asks too much at a time.

    Attributes:
        retry_after: Seconds after which it can be tried again.
    """

    status = 429

    def __init__(self, text: str, retry_after: float) -> None:
        self.retry_after = retry_after
        super().__init__(text)


class AuthError(MasterError):
    """Somebody could not prove who they are."""


class WrongCredentials(AuthError):  # noqa: N818
    """Unknown user, wrong password, unknown or expired token: deliberately not told apart."""


class TooManyFailures(AuthError):  # noqa: N818
    """Too many wrong passwords for this user from this address.

    Attributes:
        retry_after: Seconds until the next attempt is looked at.
    """

    def __init__(self, retry_after: float) -> None:
        self.retry_after = retry_after
        super().__init__(retry_after)

    def __str__(self) -> str:
        return (
            "too many failed logins for this user from your address; "
            f"try again in {math.ceil(self.retry_after)} s"
        )


class TooManyLogins(AuthError):  # noqa: N818
    """Too many logins from this address wait to be checked."""

    def __str__(self) -> str:
        return "too many log in at the same time; try again in a moment"


class TransitionError(InvalidTransitionError, MasterError):
    """An event that the life cycle of a robot or container does not allow in the present state."""


class StoreError(MasterError):
    """The store cannot be read or written."""


class StoreBusy(StoreError):  # noqa: N818
    """Another process owns the state folder."""


class TaskSetAway(MasterError):  # noqa: N818
    """The task set that is to be asked is not connected, or did not answer in time."""
