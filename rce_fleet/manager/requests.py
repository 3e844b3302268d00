"""Answers requests of the API: finds the route, checks the role, and turns errors into answers."""

from __future__ import annotations

import json
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

from pydantic import BaseModel, ValidationError

from rce_fleet.exceptions import (
    FleetError,
    JournalError,
    KeyReusedError,
    PlannerSilentError,
    RevisionError,
    TaskRefusedError,
    TransitionError,
    UnknownTaskError,
)

if TYPE_CHECKING:
    from rce_fleet.manager.manager import FleetManager

MOST_BODY = 1_000_000
"""Characters of a request's body."""


class BadRequestError(Exception):
    """The request cannot be understood; the text says what is wrong."""


_STATUS: dict[type[Exception], int] = {
    UnknownTaskError: 404,
    PlannerSilentError: 503,
    TaskRefusedError: 409,
    TransitionError: 409,
    KeyReusedError: 409,
    RevisionError: 412,
    JournalError: 507,
    FleetError: 500,
    BadRequestError: 422,
}
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class FleetRequest:
    """A request, as the station passes it on.

    Attributes:
        method: ``GET``, ``POST``, ``PUT``, ``PATCH`` or ``DELETE``.
        path: Below ``/api/v1``, with its query.
        body: JSON; empty: none.
        user: Who asks.
        role: ``viewer``, ``operator`` or ``admin``.
        key: The Idempotency-Key; empty: none.
        revision: If-Match; empty: none.
    """

    method: str
    path: str
    body: str = ""
    user: str = ""
    role: str = "viewer"
    key: str = ""
    revision: str = ""


@dataclass(frozen=True, slots=True)
class FleetAnswer:
    """An answer: status as in HTTP, a body of JSON, and the revision of what it describes."""

    status: int
    body: str
    revision: str = ""


@dataclass(slots=True)
class Call:
    """A request that has found its route.

    Attributes:
        manager: The manager.
        request: The request.
        names: The parts of the path that the route leaves open.
        query: The query's parameters.
        now: Seconds since 1970.
    """

    manager: FleetManager
    request: FleetRequest
    names: tuple[str, ...]
    query: dict[str, str]
    now: float
    _used: set[str] = field(default_factory=set)

    def model(self, kind: type[M]) -> M:
        """Return the body.

        Raises:
            BadRequestError: It is not JSON, or not what the model describes.
        """
        if len(self.request.body) > MOST_BODY:
            raise BadRequestError(
                f"the body has {len(self.request.body)} characters; {MOST_BODY} are possible"
            )
        try:
            return kind.model_validate_json(self.request.body or "{}")
        except ValidationError as error:
            raise BadRequestError(_explain(error)) from error

    def revision(self) -> int | None:
        """Return the revision of If-Match; None if there is none.

        Raises:
            BadRequestError: It is not a revision.
        """
        text = self.request.revision.strip().removeprefix("W/").strip('"')
        if text in ("", "*"):
            return None
        if not text.isdecimal() or len(text) > 18:  # noqa: PLR2004 - digits of a 64-bit number
            raise BadRequestError(f'If-Match must be a revision, such as "3", not {self.request.revision!r}')
        return int(text)

    def check_revision(self, what: str, revision: int) -> None:
        """Check that If-Match, if it is given, is the present revision.

        Raises:
            RevisionError: It is another one.
        """
        asked = self.revision()
        if asked is not None and asked != revision:
            raise RevisionError(
                f"{what} is at revision {revision}, not {asked}: read it again, then change it"
            )

    def number(
        self, name: str, default: float | None, least: float = 0.0, most: float = 1e18
    ) -> float | None:
        """Return a number of the query.

        Raises:
            BadRequestError: It is not a number, or out of range.
        """
        text = self.query.get(name)
        if text is None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            raise BadRequestError(f"{name} must be a number within {least:g} .. {most:g}, not {text!r}")
        return value

    def count(self, name: str, default: int, most: int) -> int:
        """Return a count of the query, from 0 on.

        Raises:
            BadRequestError: It is not a count, or too large.
        """
        value = self.number(name, default, 0, most)
        if value is None or value != int(value):
            raise BadRequestError(f"{name} must be a whole number, not {self.query[name]!r}")
        return int(value)

    def only(self, *names: str) -> None:
        """Check the names of the query's parameters.

        Raises:
            BadRequestError: There is another one.
        """
        for name in self.query:
            if name not in names:
                raise BadRequestError(
                    f"unknown parameter {name!r}; possible are {', '.join(names) or 'none'}"
                )


Handler: TypeAlias = Callable[[Call], Awaitable[FleetAnswer]]


@dataclass(frozen=True, slots=True)
class Route:
    """A route of the API.

    Attributes:
        method: Its method.
        path: Its path; ``{name}`` is any part.
        handler: Answers it.
        changes: Whether it changes something, which viewers may not.
    """

    method: str
    path: str
    handler: Handler
    changes: bool = False

    def pattern(self) -> re.Pattern[str]:
        """Return the regular expression of its paths."""
        return re.compile(re.sub(r"\{\w+\}", "([^/]+)", self.path))


class Router:
    """Finds the route of a request and answers it.

    Args:
        manager: The manager.
        routes: All routes.
    """

    def __init__(self, manager: FleetManager, routes: list[Route]) -> None:
        self._manager = manager
        self._routes = [(route.pattern(), route) for route in routes]

    async def answer(self, request: FleetRequest) -> FleetAnswer:
        """Answer a request; the answer says what went wrong, if something did."""
        parts = urlsplit(request.path)
        found = [
            (match, route)
            for pattern, route in self._routes
            if (match := pattern.fullmatch(parts.path.rstrip("/")))
        ]
        if not found:
            return problem(404, f"there is nothing at {parts.path}")
        fitting = [(match, route) for match, route in found if route.method == request.method]
        if not fitting:
            methods = ", ".join(sorted(route.method for _, route in found))
            return problem(405, f"{parts.path} takes {methods}, not {request.method}")
        match, route = fitting[0]
        if route.changes and (refusal := self._refuse_change(request)) is not None:
            return refusal
        if self._manager.is_stale:
            return problem(507, self._manager.failure)
        query = dict(parse_qsl(parts.query, keep_blank_values=True))
        names = tuple(unquote(name) for name in match.groups())
        call = Call(self._manager, request, names, query, self._manager.clock())
        try:
            return await route.handler(call)
        except (BadRequestError, FleetError) as error:
            return problem(
                next(code for kind, code in _STATUS.items() if isinstance(error, kind)), str(error)
            )

    def _refuse_change(self, request: FleetRequest) -> FleetAnswer | None:
        """Return why nothing can be changed by this request; None if it can."""
        if request.role not in ("operator", "admin"):
            role = request.role or "(none)"
            return problem(403, f"the role {role} may not change anything; log in as an operator")
        return problem(507, self._manager.failure) if self._manager.failure else None


def shown(model: BaseModel, status: int = 200, revision: int | None = None) -> FleetAnswer:
    """Return an answer with a model as its body."""
    return FleetAnswer(status, model.model_dump_json(), "" if revision is None else f'"{revision}"')


def problem(status: int, text: str) -> FleetAnswer:
    """Return an answer that says why a request failed."""
    return FleetAnswer(status, json.dumps({"error": text}))


def _explain(error: ValidationError) -> str:
    found: list[Any] = error.errors(include_url=False, include_input=False, include_context=False)
    texts = [f"{'.'.join(map(str, one['loc'])) or 'body'}: {one['msg']}" for one in found[:5]]
    return "; ".join(texts)
