"""The records of users: accounts, tokens, limits, packages, and answers to their requests.

All are immutable and go to the store: a change replaces a record.
"""

from __future__ import annotations

from enum import Enum

from msgspec import Struct


class UserRole(Enum):
    """What a user may do."""

    VIEWER = "viewer"
    """Sees the objects of all users, and cannot change any."""
    USER = "user"
    """Their own robots and containers."""
    OPERATOR = "operator"
    """The same; also sees the objects of all users, and controls every fleet at its station."""
    ADMIN = "admin"
    """All objects of all users."""

    @property
    def sees_all(self) -> bool:
        """Whether the role sees the objects of all users."""
        return self is not UserRole.USER

    @property
    def changes(self) -> bool:
        """Whether the role may change anything."""
        return self is not UserRole.VIEWER


class User(Struct, frozen=True, kw_only=True):
    """A user who may log in."""

    name: str
    role: UserRole
    password: str
    """argon2 over the SHA-256 hex of the password."""
    created: float
    """Seconds since 1970."""
    password_epoch: int = 0
    """A robot with a smaller epoch that came in by password did so by an earlier one."""


TOKEN_ID_LENGTH = 12
ROBOT_SCOPE = "robot:"
METRICS_SCOPE = "metrics"
FLEET_SCOPE = "fleet"
"""Of a program that uses operator stations, with its user's role there."""


class Token(Struct, frozen=True, kw_only=True):
    """A bearer token; only its digest is kept."""

    digest: str
    """SHA-256 hex of the token."""
    user: str
    label: str
    created: float
    expires: float
    """Seconds since 1970; 0: never."""
    used: float = 0.0
    """When it was last used, to the minute; 0: never."""
    scope: str = ""
    """Its scope: all permissions of its user (empty), or one of ``robot:ID``, ``metrics`` and ``fleet``."""

    @property
    def id(self) -> str:
        """What people call it by; it is not secret."""
        return self.digest[:TOKEN_ID_LENGTH]

    @property
    def robot(self) -> str:
        """The only robot ID that it is good for; empty: it is for other things."""
        return self.scope.removeprefix(ROBOT_SCOPE) if self.scope.startswith(ROBOT_SCOPE) else ""

    def is_expired(self, now: float) -> bool:
        """Return whether it has expired."""
        return bool(self.expires) and self.expires <= now


class UserLimits(Struct, frozen=True, kw_only=True):
    """What one user may have, where that is not as for all. None: as for all; 0: no limit."""

    user: str
    containers: float | None = None
    slots: float | None = None
    cpu: float | None = None
    """Cores."""
    memory: float | None = None
    """Bytes."""
    packages: float | None = None
    disk: float | None = None
    """Bytes of the packages' files and of the volumes."""


class KnownLogin(Struct, frozen=True, kw_only=True):
    """A password that was right once, so that it need not be hashed again."""

    user: str
    mark: str
    """Keyed hash, in hex, over user, stored password and what the client sent."""


class PackageKey(Struct, frozen=True, kw_only=True):
    """A public key by which a user signs packages."""

    user: str
    key: str
    """In hex."""
    label: str = ""
    created: float
    """Seconds since 1970."""

    @property
    def id(self) -> str:
        """Its key in the table."""
        return package_key_key(self.user, self.key)


def package_key_key(user: str, key: str) -> str:
    """Tell the key, in the table, of a user's public key."""
    return f"{user}/{key}"


class UserPackage(Struct, frozen=True, kw_only=True):
    """A version of a package that a user brought. It never changes."""

    user: str
    name: str
    version: str
    sha256: str
    """Of the archive, in hex."""
    digest: str
    """SHA-256, in hex, of what the archive unpacks to."""
    signature: str
    key: str
    """The public key that made the signature, in hex."""
    packed: int
    """Bytes of the archive."""
    size: int
    """Bytes of all files."""
    files: int
    created: float
    """Seconds since 1970."""
    description: str = ""
    executables: tuple[str, ...] = ()
    """What nodes can name."""
    requirements: bool = False
    """Whether it has a ``requirements.txt``."""

    @property
    def id(self) -> str:
        """``user/name@version``."""
        return user_package_key(self.user, self.name, self.version)


def user_package_key(user: str, name: str, version: str) -> str:
    """Tell the key of a package."""
    return f"{user}/{name}@{version}"


class KeptAnswer(Struct, frozen=True, kw_only=True):
    """The answer to a request with an ``Idempotency-Key``; a repeat of the request gets it again."""

    user: str
    """Who made the request."""
    digest: str
    """SHA-256, in hex, of the key."""
    created: float
    """Seconds since 1970."""
    status: int
    mark: str
    """Tells by which secret of the engine the other fields were made."""
    request: str
    """Keyed hash, in hex, of the request."""
    body: bytes = b""
    """Encrypted; empty: the answer has none."""

    @property
    def id(self) -> str:
        """Its key in the table."""
        return kept_answer_key(self.user, self.digest)


def kept_answer_key(user: str, digest: str) -> str:
    """Tell the key, in the table, of the answer to a user's request."""
    return f"{user}/{digest}"
