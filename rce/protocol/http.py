"""The two HTTP requests with which a client connects, without I/O.

First ``GET /?userID=U&version=V`` at the master, which answers with the robot endpoint's URL; then the
WebSocket handshake there, ``GET /?userID=U&robotID=R&password=P``, or without a password and with the header
``Authorization: Bearer``. Wire source: ``docs/protocol.md``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, parse_qsl

import msgspec

from rce.model import is_name
from rce.protocol.exceptions import HandshakeError

if TYPE_CHECKING:
    from collections.abc import Sequence

CURRENT_VERSION = "20130902"
"""The protocol's version, a date."""
MIN_VERSION = "20130415"
"""The oldest version that is served."""

AUTH_KEY, AUTH_BEARER = "auth", "bearer"
"""A client that asks with ``auth=bearer`` is told the same if its credential may go in a header."""

_MAX_QUERY = 4096
_MAX_FIELDS = 32
_VERSION = re.compile(r"[0-9]{1,16}")
_PASSWORD = re.compile(r"[0-9A-Fa-f]{64}")
_TOKEN = re.compile(r"[A-Za-z0-9._~+/=-]{1,256}")

_BAD_REQUEST, _UNAUTHORIZED, _GONE, _NOT_IMPLEMENTED = 400, 401, 410, 501


@dataclass(frozen=True, slots=True)
class MasterRequest:
    """A client asks where to connect."""

    user: str
    version: str
    asks_for_header: bool = False
    """Whether the client wants to know if its credential may go in a header."""

    @property
    def is_outdated(self) -> bool:
        """Whether the client is served but could be newer."""
        return int(self.version) < int(CURRENT_VERSION)


@dataclass(frozen=True, slots=True)
class Credentials:
    """The credentials of a robot that connects."""

    user: str
    robot: str
    password: str = field(default="", repr=False)
    """SHA-256 of the password, 64 lower-case hex characters; empty: there is a token."""
    token: str = field(default="", repr=False)
    """The robot's own token; empty: there is a password."""


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
    return MasterRequest(user, version, asks_for_header=(AUTH_KEY, AUTH_BEARER) in _pairs(query))


def master_reply(request: MasterRequest, url: str, *, header: bool = False) -> bytes:
    """Write the body of the master's answer (JSON, UTF-8).

    Args:
        request: The client's request.
        url: WebSocket URL of the robot endpoint, such as ``ws://host:9010/``.
        header: Whether that endpoint takes the credential in a header; sent only to clients that ask.
    """
    body = {"url": url}
    if header and request.asks_for_header:
        body[AUTH_KEY] = AUTH_BEARER
    if request.is_outdated:
        body["current"] = CURRENT_VERSION
    return msgspec.json.encode(body)


def read_credentials(query: str, authorization: Sequence[str] = ()) -> Credentials:
    """Read the credentials in a WebSocket handshake.

    Args:
        query: What comes after the ``?``, still percent-encoded.
        authorization: Values of the header ``Authorization``. With one, the query needs no password.

    Raises:
        HandshakeError: 400 for a missing, repeated or malformed parameter, or a credential in both places;
            401 for a password that is not a SHA-256, or a header that is not understood.
    """
    if authorization:
        return _read_header(query, authorization)
    values = _single_values(query, ("userID", "robotID", "password"))
    _check_name("userID", values["userID"])
    _check_name("robotID", values["robotID"])
    if not _PASSWORD.fullmatch(values["password"]):
        reason = "Parameter 'password' must be the SHA-256 of the password in 64 hexadecimal characters."
        raise HandshakeError(_UNAUTHORIZED, reason)
    return Credentials(values["userID"], values["robotID"], values["password"].lower())


def _read_header(query: str, authorization: Sequence[str]) -> Credentials:
    values = _single_values(query, ("userID", "robotID"))
    _check_name("userID", values["userID"])
    _check_name("robotID", values["robotID"])
    if any(name == "password" for name, _ in _pairs(query)):
        reason = "Give either the header 'Authorization' or the parameter 'password', not both."
        raise HandshakeError(_BAD_REQUEST, reason)
    scheme, _, text = authorization[0].partition(" ")
    text = text.strip()
    if len(authorization) != 1 or scheme.lower() != "bearer" or not _TOKEN.fullmatch(text):
        reason = "The header 'Authorization' must be 'Bearer' and the robot's token or password's SHA-256."
        raise HandshakeError(_UNAUTHORIZED, reason)
    if _PASSWORD.fullmatch(text):
        return Credentials(values["userID"], values["robotID"], password=text.lower())
    return Credentials(values["userID"], values["robotID"], token=text)


FEATURES_KEY = "features"
"""Parameter of the WebSocket handshake: the client's features beyond the first protocol, by commas."""
FEATURES_HEADER = "RCE-Features"
"""Header of the answer: those features that the endpoint knows too."""
LATCH = "latch"
"""Feature: latched messages name their source, and ``LT`` tells which sources' are in force."""
SINGLE_FRAME = "single-frame"
"""Feature: a message that is binary as a whole travels in one frame, see :mod:`rce.protocol.single`."""
FEATURES = frozenset((LATCH, SINGLE_FRAME))
"""The features of this release."""


def read_features(query: str) -> frozenset[str]:
    """Return the features that a client asks for in its WebSocket handshake and that are known here.

    Args:
        query: What comes after the ``?``, still percent-encoded; one that :func:`read_credentials` took.
    """
    asked = {word for name, value in _pairs(query) if name == FEATURES_KEY for word in value.split(",")}
    return FEATURES & asked


def _pairs(query: str) -> list[tuple[str, str]]:
    """Return the parameters of a query that is known to be readable."""
    return parse_qsl(query, keep_blank_values=True, max_num_fields=_MAX_FIELDS)


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
