"""The routes of the REST API: their permissions, and the arguments of their handlers."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from rce.guard import TrustedProxies
from rce.web import routes
from rce.web.openapi import Query
from rce.web.writing import write
from rce_master.exceptions import (
    EndedError,
    ForbiddenError,
    InvalidRequestError,
    NotFoundError,
    WrongCredentialsError,
)
from rce_master.http.forwarded import HEADER, ForwardingKey
from rce_master.state.user_records import User, UserRole

if TYPE_CHECKING:
    from aiohttp import web
    from aiohttp.web import StreamResponse
    from pydantic import BaseModel

    from rce_master.answers import Answers, PendingAnswer
    from rce_master.audit import AuditLog
    from rce_master.auth import Authenticator
    from rce_master.events import EventLog
    from rce_master.executions import Executions
    from rce_master.leadership import Fence
    from rce_master.leadership.drains import MasterDrains
    from rce_master.other_audits import OtherAudits
    from rce_master.packages.service import PackageService
    from rce_master.quotas import Quotas
    from rce_master.reconciler import Reconciler
    from rce_master.state.commands import Command
    from rce_master.state_service import StateService
    from rce_master.tokens import Tokens

M = TypeVar("M", bound="BaseModel")

ACCESS_CHECK_S = 15.0
"""Seconds after its expiry during which a token may still keep a stream open."""
ENDED = "your access ended: the token was revoked or expired, or the user was changed; log in again"
"""The last message of streams that end because of an expired token."""

_NUMBER = re.compile(r"-?[0-9]{1,18}")


@dataclass(frozen=True, slots=True)
class Services:
    """The services of the handlers."""

    state_service: StateService
    reconciler: Reconciler
    authenticator: Authenticator
    events: EventLog
    clock: Callable[[], float]
    """Seconds since 1970."""
    token_lifetime: float
    """Seconds."""
    packages: PackageService
    executions: Executions
    tokens: Tokens
    quotas: Quotas
    audit: AuditLog
    answers: Answers
    dev: bool
    """Whether this is development mode."""
    proxies: TrustedProxies = field(default_factory=TrustedProxies)
    fence: Fence | None = None
    """Tells whether this master leads; None if there is no other one."""
    forwarding: ForwardingKey | None = None
    """Of the stand-bys that forward requests to this master; None if there are none."""
    drains: MasterDrains | None = None
    """Of this master and the others; None if there are no others."""
    other_audits: OtherAudits | None = None
    """The audit logs of the others; None if there are none."""
    warnings: Sequence[Callable[[], str]] = ()
    """What an operator has to know while the master works; each is empty if it is well."""


@dataclass(frozen=True, slots=True)
class Call:
    """An authenticated request."""

    request: web.Request
    services: Services
    user: User | None
    """None only on public routes."""
    token: str
    body: BaseModel | None
    parts: Mapping[str, str]
    """The parts of the path that the route names, by their names."""
    pending: PendingAnswer | None = None
    """Keeps the answer, if the request has an ``Idempotency-Key``."""

    @property
    def address(self) -> str:
        """The address of the request, as reported by a stand-by or by trusted proxies."""
        services = self.services
        if services.fence is not None and services.forwarding is not None:
            told = services.forwarding.read(self.request.headers.get(HEADER, ""), services.fence.term)
            if told is not None:
                return told
        transport = self.request.transport
        peer = None if transport is None else transport.get_extra_info("peername")
        return self.services.proxies.origin(peer, self.request.headers.getall("X-Forwarded-For", ()))

    @property
    def caller(self) -> User:
        """The calling user."""
        assert self.user is not None
        return self.user

    @property
    def is_admin(self) -> bool:
        """Whether the caller is an administrator."""
        return self.user is not None and self.user.role is UserRole.ADMIN

    @property
    def is_still_valid(self) -> bool:
        """Whether the caller still has the permission; for long answers."""
        try:
            user, _ = self.services.tokens.find(self.token)
        except WrongCredentialsError:
            return False
        return user == self.user

    def check_again(self) -> User:
        """Return the caller as they are now, after a body that may have come slowly.

        Raises:
            WrongCredentialsError: The token is not valid any more.
        """
        user, _ = self.services.tokens.find(self.token)
        return user

    async def write(self, response: StreamResponse, data: bytes) -> None:
        """Send a part of a stream.

        Raises:
            ConnectionError: The client is gone, or takes nothing.
            FencedError: This master leads no more, and says nothing that another one may have changed.
        """
        self.check_lead()
        await write(self.request, response, data)

    def check_lead(self) -> None:
        """Check that this master leads, if there may be others.

        Raises:
            FencedError: It does not.
        """
        if self.services.fence is not None:
            self.services.fence.check()

    async def lasts(self, seconds: float) -> bool:
        """Wait; return False as soon as the caller has lost the permission.

        Raises:
            EndedError: This master ends.
        """
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while self.is_still_valid:
            if self.services.events.is_closed:
                raise EndedError
            left = end - loop.time()
            if left <= 0:
                return True
            await self.services.events.wait_change(min(left, ACCESS_CHECK_S))
        return False

    @property
    def owner(self) -> str:
        """The user of the robots and containers: the caller, or ``?user=`` for an administrator.

        Raises:
            ForbiddenError: The caller may not name another user.
            NotFoundError: The user does not exist.
        """
        return self._owner(looks=self.request.method == "GET")

    @property
    def controlled_owner(self) -> str:
        """The same for a GET that changes something, such as a command's WebSocket."""
        return self._owner(looks=False)

    def _owner(self, *, looks: bool) -> str:
        name = self.request.query.get("user", self.caller.name)
        looks = looks and self.caller.role.sees_all
        if name != self.caller.name and not self.is_admin and not looks:
            raise ForbiddenError(
                "only an administrator controls, and only roles above user see, what others have"
            )
        if name not in self.services.state_service.tables.users:
            raise NotFoundError(f"there is no user {name!r}")
        return name

    @property
    def scope(self) -> str | None:
        """The user whose objects to list; None: all users, the default of callers who may see them."""
        return None if self.caller.role.sees_all and "user" not in self.request.query else self.owner

    async def submit(self, command: Command, reply: BaseModel | None = None) -> None:
        """Do a command; with an ``Idempotency-Key``, the answer is stored together with what it does.

        Args:
            command: The command.
            reply: What the handler returns afterwards.

        Raises:
            RefusedError: It cannot be done; nothing changed.
            StoreError: It cannot be stored; nothing changed.
        """
        if self.pending is not None:
            command = self.pending.with_answer(command, body_of(reply))
        await self.services.state_service.submit(command)

    def path(self, name: str) -> str:
        """A part of the path."""
        return self.parts[name]

    def query(self, name: str) -> str:
        """Return a required query parameter.

        Raises:
            InvalidRequestError: It is missing.
        """
        try:
            return self.request.query[name]
        except KeyError:
            raise InvalidRequestError(f"query parameter {name!r} is missing") from None

    def number(self, name: str, default: int) -> int:
        """Return a query parameter that is an integer.

        Raises:
            InvalidRequestError: It is not an integer, or is out of range.
        """
        text = self.request.query.get(name, str(default))
        if not _NUMBER.fullmatch(text):
            raise InvalidRequestError(f"query parameter {name!r} must be a whole number of at most 18 digits")
        return int(text)

    def read(self, model: type[M]) -> M:
        """Return the body, which the route declared to be of this model."""
        assert isinstance(self.body, model)
        return self.body


def body_of(reply: BaseModel | None) -> bytes:
    """Return the body of an answer; empty: none."""
    return b"" if reply is None else reply.model_dump_json(by_alias=True).encode()


Handler = Callable[[Call], Awaitable["BaseModel | StreamResponse | None"]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Route(routes.Route[Handler]):
    """A method of a path, and its permissions."""

    admin: bool = False
    any_role: bool = False
    """Whether read-only users may use it too."""
    stations: bool = False
    """Whether tokens for operator stations may use it: a station asks for their user, and notes actions."""
    acts: bool = False
    """Whether it makes a change although it is a GET."""

    def told(self) -> dict[str, Any]:
        """Return its OpenAPI description: permissions and possible errors."""
        return {
            "summary": self.summary + (" (administrators only)" if self.admin else ""),
            "errors": tuple(set(self._errors())),
        }

    def _errors(self) -> Iterator[int]:
        """Return the statuses of its possible errors."""
        yield from (401, 403, 421, 422, 429)
        if "{" in self.path or OF_USER in self.query:
            yield 404
        if self.body is not None or self.upload:
            yield from (408, 413)
        if self.keyed:
            yield 400
        if self.method != "GET":
            yield from (409, 503)
        yield from self.errors


def route_table(group: str) -> routes.RouteTable[Route]:
    """Return an empty table of routes of the master."""
    return routes.RouteTable(group, Route)


OF_USER = Query(
    name="user",
    description="Whose. Those of others are for administrators; to be read for viewers and operators too, but"
    " tokens. Default: own, in lists all users'.",
)
