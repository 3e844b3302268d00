"""Users of a station, their permissions, and the interface of what authenticates them. Pure."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from typing import Protocol

from rce_client.exceptions import ClientError

_VIEW_ROLES = frozenset({"viewer", "operator", "admin"})
_CONTROL_ROLES = frozenset({"operator", "admin"})


class AuthenticationError(ClientError):
    """A login is refused, or tokens cannot be checked now.

    Attributes:
        status: HTTP status of the response.
        retry_after: Seconds after which to try again; 0 if unknown.
    """

    def __init__(self, status: int, text: str, retry_after: int = 0) -> None:
        self.status = status
        self.retry_after = retry_after
        super().__init__(text)


@dataclass(frozen=True, slots=True)
class StationUser:
    """An authenticated user of a station.

    Attributes:
        name: Name of the engine's user.
        role: The user's role at the engine.
        is_owner: Whether the fleet belongs to this user.
        is_anonymous: Whether it stands for requests without a token, which only this machine's user may send.
    """

    name: str
    role: str
    is_owner: bool = False
    is_anonymous: bool = False

    @property
    def may_view(self) -> bool:
        """Whether the user may see the fleet."""
        return self.is_owner or self.role in _VIEW_ROLES

    @property
    def may_control(self) -> bool:
        """Whether the user may send robots and block cells."""
        return (self.is_owner and self.role != "viewer") or self.role in _CONTROL_ROLES


@dataclass(frozen=True, slots=True)
class AuditedAction:
    """An action of a user at a station, for the engine's audit log.

    Attributes:
        name: The action, such as ``set_goal``.
        subject: The robot or cell that it concerns.
        detail: Its parameters, in words.
        address: Address of the user's computer.
        done: Whether it was carried out; False if it was refused.
    """

    name: str
    subject: str
    detail: str
    address: str
    done: bool = True


class Authenticator(Protocol):
    """Finds the user of a token, and logs users in and out."""

    @property
    def has_logins(self) -> bool:
        """Whether users can log in at the page by name and password."""

    async def authenticate(self, token: str) -> StationUser | None:
        """Return the user of a token, or None if the token is not valid.

        Raises:
            AuthenticationError: The token cannot be checked now.
        """

    def last_known(self, token: str) -> StationUser | None:
        """Return the user of a token as it was last checked; None if it was not, or was not valid then."""

    async def log_in(self, user: str, password: str, address: str) -> str:
        """Return a token for a user.

        Raises:
            AuthenticationError: The password is wrong, or it cannot be checked now.
        """

    async def log_out(self, token: str) -> None:
        """Revoke a token."""

    def audit(self, token: str, action: AuditedAction) -> None:
        """Record an action in the audit log. Does not wait."""


class TokenAuthenticator:
    """One token for all users, or none: for a fleet without an engine, which has no user accounts.

    Args:
        token: The token that requests must carry; empty to accept every request of this machine's user.
    """

    has_logins = False

    def __init__(self, token: str = "") -> None:
        self._token = token.encode()

    async def authenticate(self, token: str) -> StationUser | None:
        """Return the user ``operator`` if the token is right."""
        if not self._token:
            return StationUser("operator", "operator", is_anonymous=True)
        right = hmac.compare_digest(token.encode(errors="surrogateescape"), self._token)
        return StationUser("operator", "operator") if right else None

    def last_known(self, token: str) -> StationUser | None:
        """Return None: tokens can always be checked."""
        del token
        return None

    async def log_in(self, user: str, password: str, address: str) -> str:
        """Refuse the login: there are no user accounts.

        Raises:
            AuthenticationError: Always.
        """
        del user, password, address
        raise AuthenticationError(
            404, "this station has no user accounts; send its token as 'Authorization: Bearer TOKEN'"
        )

    async def log_out(self, token: str) -> None:
        """Do nothing: the token is valid until the station stops."""

    def audit(self, token: str, action: AuditedAction) -> None:
        """Do nothing: without an engine there is no audit log."""
