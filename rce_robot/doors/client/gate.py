"""Admission to the door, decided while the WebSocket handshake waits for its answer."""

from __future__ import annotations

import asyncio
import logging
import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from websockets.protocol import State

from rce.guard import LogThrottle, LoopShare, TrustedProxies, address_of
from rce.model import EndpointId
from rce.protocol import FEATURES_HEADER, Credentials, HandshakeError, read_credentials, read_features
from rce.web.origin import ServerNames, is_foreign
from rce_robot.doors.client.session import Session
from rce_robot.doors.client.websocket import RobotSocket

if TYPE_CHECKING:
    from collections.abc import Collection

    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    from rce_robot.doors.base import Admission
    from rce_robot.namespace import Namespace
    from rce_robot.settings import SessionSettings

_log = logging.getLogger(__name__)

_FORBIDDEN, _CONFLICT = 403, 409


class Gate:
    """Answers handshakes. Used as ``process_request`` of the WebSocket server."""

    def __init__(
        self,
        admission: Admission,
        settings: SessionSettings,
        origins: Collection[str],
        proxies: TrustedProxies | None = None,
        names: ServerNames | None = None,
    ) -> None:
        self._admission = admission
        self._settings = settings
        self._origins = origins
        self._names = names or ServerNames()
        self._proxies = proxies or TrustedProxies()
        self._share = LoopShare()
        self._throttle = LogThrottle()

    async def admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Admit a robot (None), or return the refusal."""
        assert isinstance(connection, RobotSocket)
        connection.speak()
        if ",".join(request.headers.get_all("Upgrade")).lower() != "websocket":
            return None  # not a WebSocket handshake: the library answers it
        try:
            self._check_origin(request.headers.get_all("Origin"), request.headers.get_all("Host"))
            authorization = request.headers.get_all("Authorization")
            query = request.path.partition("?")[2].partition("#")[0]
            credentials = read_credentials(query, authorization)
            forwarded = request.headers.get_all("X-Forwarded-For")
            address = self._proxies.origin(connection.remote_address, forwarded)
            namespace = await self._claim(credentials, address)
        except HandshakeError as error:
            self._log_refusal(connection, error)
            response = connection.respond(error.status, f"{error.reason}\n")
            if error.retry_after:
                response.headers["Retry-After"] = str(math.ceil(error.retry_after))
            return response
        client = f"{address or 'an unknown address'} since {_clock()} UTC"
        features = read_features(query)
        session = Session(
            connection, namespace, self._settings, namespace.dropped, client=client, features=features
        )
        namespace.session = session
        connection.receiver = session
        connection.share_loop(self._share, namespace.id.user)
        connection.become_known()
        if connection.protocol.state is not State.CONNECTING:
            session.on_lost("the robot left during the handshake")
        return None

    async def answer(self, connection: ServerConnection, request: Request, response: Response) -> None:  # noqa: ARG002 - the library's call
        """Tell an admitted client which of its requested features it gets."""
        assert isinstance(connection, RobotSocket)
        session = connection.receiver
        if isinstance(session, Session) and session.features:
            response.headers[FEATURES_HEADER] = ",".join(sorted(session.features))

    def _log_refusal(self, connection: ServerConnection, error: HandshakeError) -> None:
        peer = address_of(connection.remote_address)
        if self._throttle.is_due(f"{peer} {error.status}", asyncio.get_running_loop().time()):
            _log.info("refused %s: %s %s", connection.remote_address, error.status, error.reason)

    def _check_origin(self, origins: list[str], hosts: list[str]) -> None:
        """Refuse requests of other sites' pages, which a browser would send from its user's network.

        Some WebSocket libraries of programs name the endpoint itself as their origin. No page has this
        origin, because the endpoint serves none, unless the page's name leads here (DNS rebinding).
        """
        if not origins or "*" in self._origins:
            return
        host = hosts[0] if len(hosts) == 1 else ""
        own = host in self._names
        for origin in origins:
            if origin not in self._origins and (not own or is_foreign(origin, host)):
                reason = (
                    f"Origin {origin[:100]} may not connect here. A program should send no Origin; the"
                    " engine's operator can allow the pages of an origin (--origin)."
                )
                raise HandshakeError(_FORBIDDEN, reason)

    async def _claim(self, credentials: Credentials, address: str) -> Namespace:
        """Log in. A dead former connection of the robot makes room for the new one."""
        try:
            spec = await self._admission.log_in(credentials, address)
        except HandshakeError as error:
            namespace = self._admission.find(EndpointId(credentials.user, credentials.robot))
            former = None if namespace is None else namespace.session
            if (
                error.status != _CONFLICT
                or namespace is None
                or (former is not None and await former.probe())
            ):
                raise
            spec = await self._admission.log_in(credentials, address)
        namespace = await self._admission.settle(spec)
        if namespace.session is not None:
            raise HandshakeError(_CONFLICT, _already(namespace.id, namespace.session.client))
        return namespace


def _already(robot: EndpointId, client: str) -> str:
    return f"robot {robot.tag!r} is connected already, from {client}; a robotID can be used once at a time"


def _clock() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
