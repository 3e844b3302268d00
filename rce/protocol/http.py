"""The two HTTP requests with which a client comes in, without I/O.

First ``GET /?userID=U&version=V`` at the master, which answers where the robot endpoint is; then the
WebSocket handshake there, ``GET /?userID=U&robotID=R&password=P``. Wire source: ``docs/protocol.md``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from urllib.parse import parse_qs

import msgspec

from rce.protocol.exceptions import HandshakeError
from rce.protocol.names import is_name

CURRENT_VERSION = "20130902"
"""The protocol's version, a date."""
MIN_VERSION = "20130415"
"""The oldest version that is served."""

_MAX_QUERY = 4096
_MAX_FIELDS = 32
_VERSION = re.compile(r"[0-9]{1,16}")
_PASSWORD = re.compile(r"[0-9A-Fa-f]{64}")

_BAD_REQUEST, _UNAUTHORIZED, _GONE, _NOT_IMPLEMENTED = 400, 401, 410, 501


@dataclass(frozen=True, slots=True)
class MasterRequest:
    """A client asks where to connect."""

    user: str
    version: str

    @property
    def is_outdated(self) -> bool:
        """Whether the client is served but could be newer."""
        return int(self.version) < int(CURRENT_VERSION)


@dataclass(frozen=True, slots=True)
class Credentials:
    """Who wants to connect a robot."""

    user: str
    robot: str
    password: str = field(repr=False)
    """SHA-256 of the password, 64 lower-case hex characters."""


def read_master_request(query: str) -> MasterRequest:
    """Read the query of a client's first request.

    Args:
        query: What comes after the ``?``, still percent-encoded.

    Raises:
        HandshakeError: 400 for a missing, repeated or malformed parameter, 410 for a version that is no
            longer served, 501 for one that is not served yet.
    """
    values = _single_values(query, ("userID", "version"))
    user, version = values["userID"], values["version"]
    _check_name("userID", user)
    if not _VERSION.fullmatch(version):
        raise HandshakeError(_BAD_REQUEST, f"Parameter 'version' must be a date such as {CURRENT_VERSION}.")
    if int(version) < int(MIN_VERSION):
        reason = f"Client version {version} is no longer supported; use {MIN_VERSION} to {CURRENT_VERSION}."
        raise HandshakeError(_GONE, reason)
    if int(version) > int(CURRENT_VERSION):
        reason = f"Client version {version} is newer than this server; use {CURRENT_VERSION}."
        raise HandshakeError(_NOT_IMPLEMENTED, reason)
    return MasterRequest(user, version)


def master_reply(request: MasterRequest, url: str) -> bytes:
    """Write the body of the master's answer (JSON, UTF-8).

    Args:
        request: What was asked.
        url: WebSocket URL of the robot endpoint, such as ``ws://host:9010/``.
    """
    body = {"url": url}
    if request.is_outdated:
        body["current"] = CURRENT_VERSION
    return msgspec.json.encode(body)


def read_credentials(query: str) -> Credentials:
    """Read the query of a WebSocket handshake.

    Args:
        query: What comes after the ``?``, still percent-encoded.

    Raises:
        HandshakeError: 400 for a missing, repeated or malformed parameter, 401 for a password that is no
            SHA-256.
    """
    values = _single_values(query, ("userID", "robotID", "password"))
    _check_name("userID", values["userID"])
    _check_name("robotID", values["robotID"])
    if not _PASSWORD.fullmatch(values["password"]):
        reason = "Parameter 'password' must be the SHA-256 of the password in 64 hexadecimal characters."
        raise HandshakeError(_UNAUTHORIZED, reason)
    return Credentials(values["userID"], values["robotID"], values["password"].lower())


def _single_values(query: str, names: tuple[str, ...]) -> dict[str, str]:
    if len(query) > _MAX_QUERY:
        raise HandshakeError(_BAD_REQUEST, f"The query is longer than {_MAX_QUERY} characters.")
    try:
        given = parse_qs(query, keep_blank_values=True, max_num_fields=_MAX_FIELDS, errors="strict")
    except ValueError as error:
        raise HandshakeError(_BAD_REQUEST, f"The query cannot be read: {error}.") from error
    for name in names:
        count = len(given.get(name, ()))
        if count != 1:
            problem = "is missing" if count == 0 else f"was given {count} times"
            raise HandshakeError(_BAD_REQUEST, f"Parameter {name!r} {problem}.")
    return {name: given[name][0] for name in names}


def _check_name(parameter: str, value: str) -> None:
    if not is_name(value):
        reason = f"Parameter {parameter!r} must be a name: letters, digits and '_', a letter first."
        raise HandshakeError(_BAD_REQUEST, reason)
