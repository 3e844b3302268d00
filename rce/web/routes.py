"""A table of routes with their parameters and replies, from which server and document are made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from rce.web.openapi import Operation, Query

if TYPE_CHECKING:
    from pydantic import BaseModel

MAX_SHOWN = 40
"""Characters of an unknown parameter's name that an error repeats."""

H = TypeVar("H")
"""A handler of requests: a function or a method."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Route(Generic[H]):
    """A method of a path, its parameters, its reply and its handler.

    A server whose routes have more fields derives from this.
    """

    method: str
    path: str
    """Below :data:`rce.web.openapi.PREFIX`, with ``{name}`` for its parts."""
    handler: H
    summary: str
    group: str
    name: str = ""
    """Names it in the document; the handler's name if it is empty."""
    body: type[BaseModel] | None = None
    reply: type[BaseModel] | None = None
    """None: no content, unless ``media`` says that the handler streams something."""
    media: str = "application/json"
    status: int = 200
    also: tuple[int, ...] = ()
    """Other statuses of a success, with the same content."""
    other_media: tuple[str, ...] = ()
    """Other media types of a success, which the request chooses; they are texts."""
    open: bool = False
    """Whether it can be used without a token."""
    query: tuple[Query, ...] = ()
    upload: str = ""
    """Media type of a body that the handler reads itself."""
    errors: tuple[int, ...] = ()
    """Statuses of answers that are not a success."""
    keyed: bool = False
    """Whether repeats with the same ``Idempotency-Key`` are done once."""

    @property
    def operation(self) -> Operation:
        """Its entry in the OpenAPI document."""
        told = {field.name: getattr(self, field.name) for field in fields(Operation)}
        name = self.name or getattr(self.handler, "__name__", self.summary)
        return Operation(**(told | {"name": name} | self.told()))

    def told(self) -> dict[str, Any]:
        """Return fields of :attr:`operation` that differ from those of the route."""
        return {}


def parameter_fault(route: Route[Any], given: Iterable[tuple[str, str]], also: Iterable[str] = ()) -> str:
    """Return why a request is refused: it has a query parameter twice, or one that its route does not have.

    A filter that is spelled wrongly must not return, or change, what others have. Of two values one would
    be left out.

    Args:
        route: The route.
        given: The names and values of the request's query parameters.
        also: Names that every route takes.

    Returns:
        The reason, which names the parameter; empty: all are as they should be.
    """
    known = sorted(query.name for query in route.query)
    for name, count in Counter(name for name, _ in given).items():
        if name in also:
            continue
        if name not in known:
            shown = name[:MAX_SHOWN]
            return f"query parameter {shown!r} is unknown here; known are: {', '.join(known) or 'none'}"
        if count > 1:
            return f"query parameter {name!r} is given {count} times; give it once"
    return ""


R = TypeVar("R", bound=Route[Any])


class RouteTable(Generic[R]):
    """Routes of one group, in the order in which their handlers are written.

    Example:
        >>> FLEET = RouteTable("fleet", Route[Handler])
        >>> @FLEET.route("GET", "/fleet", "The whole fleet", reply=FleetModel)
        ... async def get_fleet(request): ...

    Args:
        group: Its name in the document.
        make: The kind of route.
    """

    def __init__(self, group: str, make: type[R]) -> None:
        self.group = group
        self.routes: list[R] = []
        self._make = make

    def __iter__(self) -> Iterator[R]:
        return iter(self.routes)

    def route(self, method: str, path: str, summary: str, **options: Any) -> Callable[[H], H]:
        """Decorate a handler.

        Args:
            method: The HTTP method.
            path: See :attr:`Route.path`.
            summary: A line on its purpose.
            options: Further fields of the route.

        Raises:
            ValueError: The table has a route for that method and path already.
        """
        if any((known.method, known.path) == (method, path) for known in self.routes):
            raise ValueError(f"two handlers for {method} {path}")

        def add(handler: H) -> H:
            given = {"group": self.group, **options}
            self.routes.append(
                self._make(method=method, path=path, handler=handler, summary=summary, **given)
            )
            return handler

        return add
