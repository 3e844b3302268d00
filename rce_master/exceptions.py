"""The errors of the master.

::

    MasterError
    +-- RefusedError               a request was refused; the text says why and what to do
    |   +-- InvalidRequestError    it can never be done like this
    |   +-- NotFoundError          it names something that is not there
    |   +-- ConflictError          it contradicts what is there
    |   |   +-- UnderWayError      the same request is under way; wait
    |   +-- LimitReachedError      there are too many already
    |   +-- NoRoomError            no machine, or not its own, has enough of what a container asks for
    |   +-- ForbiddenError         this user may not do it
    |   +-- BusyError              too much of the kind is done just now
    |   +-- TooMuchError           this user asks too much at a time; wait
    +-- AuthError
    |   +-- WrongCredentialsError  unknown user, wrong password, unknown or expired token
    |   +-- TooManyFailuresError   too many wrong passwords; wait
    |   +-- TooManyLoginsError     too many people log in just now; wait
    +-- TransitionError            an event that a life cycle does not allow in the present state
    +-- StoreError                 the store cannot be read or written
    |   +-- StoreBusyError         another process owns the state folder
    |   +-- SaveTooLargeError      it takes fewer or smaller rows at a time
    |   +-- EndedError             this master ends, and takes no commands any more
    |   +-- FencedError            this master leads no more, and must not write
    |       +-- StaleTermError     another master has begun a newer term
    +-- TaskSetAwayError           the task set that is to be asked is not there
"""

from __future__ import annotations

import math

from rce.lifecycle import InvalidTransitionError
from rce.model import FaultCode


class MasterError(Exception):
    """Base of all errors of the master."""


class RefusedError(MasterError):
    """A request was refused and changed nothing.

    Attributes:
        status: The matching HTTP status.
        code: The kind of the refusal, for programs.
    """

    status = 400
    code = FaultCode.INVALID


class InvalidRequestError(RefusedError):
    """The request is invalid."""

    status = 422
    code = FaultCode.INVALID


class NotFoundError(RefusedError):
    """The request names an object that does not exist."""

    status = 404
    code = FaultCode.NOT_FOUND


class ConflictError(RefusedError):
    """The request conflicts with the present state."""

    status = 409
    code = FaultCode.CONFLICT


class UnderWayError(ConflictError):
    """A request with the same ``Idempotency-Key`` is under way."""

    def __str__(self) -> str:
        return "a request with this Idempotency-Key is under way; repeat it in a moment for its answer"


class LimitReachedError(RefusedError):
    """The maximum number of objects of this kind is reached."""

    status = 409
    code = FaultCode.LIMIT


class NoRoomError(RefusedError):
    """No machine, or not the container's own one, has the resources that it asks for."""

    status = 409
    code = FaultCode.NO_ROOM


class ForbiddenError(RefusedError):
    """The user may not do it."""

    status = 403
    code = FaultCode.FORBIDDEN


class BusyError(RefusedError):
    """Too many requests of this kind are in progress."""

    status = 503
    code = FaultCode.BUSY


class TooMuchError(RefusedError):
    """A user exceeds their rate of requests.

    Attributes:
        retry_after: Seconds until the next attempt.
    """

    status = 429
    code = FaultCode.BUSY

    def __init__(self, text: str, retry_after: float) -> None:
        self.retry_after = retry_after
        super().__init__(text)


class AuthError(MasterError):
    """Authentication failed."""


class WrongCredentialsError(AuthError):
    """Unknown user, wrong password, unknown or expired token: deliberately not distinguished."""


class TooManyFailuresError(AuthError):
    """Too many wrong passwords for this user from this address.

    Attributes:
        retry_after: Seconds until the next attempt is worth while.
    """

    def __init__(self, retry_after: float) -> None:
        self.retry_after = retry_after
        super().__init__(retry_after)

    def __str__(self) -> str:
        return (
            "too many failed logins for this user from your address; "
            f"try again in {math.ceil(self.retry_after)} s"
        )


class TooManyLoginsError(AuthError):
    """Too many logins from this address wait to be checked."""

    def __str__(self) -> str:
        return "too many log in at the same time; try again in a moment"


class TransitionError(InvalidTransitionError, MasterError):
    """An event that the life cycle of a robot or container does not allow in the present state."""


class StoreError(MasterError):
    """The store cannot be read or written."""


class StoreBusyError(StoreError):
    """Another process owns the state folder."""


class SaveTooLargeError(StoreError):
    """The store takes fewer or smaller rows at a time; nothing was written."""


class EndedError(StoreError):
    """This master ends: it takes no commands any more.

    What it wrote last may have been stored or not; only the next one knows.
    """

    def __str__(self) -> str:
        return "this master ends; ask again when it, or another one, has started"


class FencedError(StoreError):
    """This master does not lead any more: it must not write, nor answer from what it knows.

    What it wrote last may have been stored or not; only the next leader knows.
    """


class StaleTermError(FencedError):
    """Another master has begun a newer term; nothing was written.

    Args:
        term: The term of the refused write.
        newest: The newest term of the store.
    """

    def __init__(self, term: int, newest: int) -> None:
        super().__init__(term, newest)
        self.term = term
        self.newest = newest

    def __str__(self) -> str:
        return (
            f"the store is in term {self.newest}, and this master writes in term {self.term}: another master"
            " has taken over; restart this one"
        )


class TaskSetAwayError(MasterError):
    """The task set to ask is not connected, or did not answer in time."""
