"""Finds logs at the machine of a container, or at its earlier machines."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

import msgspec

from rce.control import ControlError, LogChunk, LogQuery, TaskSetKind
from rce.model import EndpointId, is_name
from rce_master.exceptions import NotFoundError, TaskSetAwayError
from rce_master.state.records import Container
from rce_master.state.tables import Tables


class LogReader(Protocol):
    """The log interface of a connected task set."""

    async def read_log(
        self,
        id: str,  # noqa: A002 - wire name
        node: str,
        offset: int = 0,
        limit: int = 65536,
        query: LogQuery = LogQuery(),  # noqa: B008 - it is frozen
    ) -> LogChunk:
        """Read a piece of a log."""


class LogRequest(NamedTuple):
    """The log to read."""

    id: str
    """Endpoint id of the container."""
    node: str
    """Node tag; empty for the environment's own log."""
    offset: int = 0
    limit: int = 65536
    query: LogQuery = LogQuery()


async def read_log(tables: Tables, peers: Mapping[str, LogReader], request: LogRequest) -> LogChunk:
    """Read a log of an existing container, or of an earlier incarnation that a machine still keeps.

    Args:
        tables: The state.
        peers: The connected task sets by name.
        request: The log to read.

    Raises:
        NotFoundError: The container, node or log does not exist.
        TaskSetAwayError: Its task set is not connected or does not answer.
    """
    user, _, tag = request.id.partition("/")
    if not is_name(user) or not is_name(tag):
        raise NotFoundError(
            f"there is no container {tag!r}: a name has letters, digits and '_', a letter first"
        )
    container = tables.container(request.id)
    if container is None or not _is_present(tables, request):
        query = msgspec.structs.replace(request.query, since=_owner_since(tables, request.id))
        request = request._replace(query=query)
    query = request.query
    if container is None:
        return await _read_anywhere(tables, peers, request)
    if query.previous or query.incarnation:
        return await _read_earlier(tables, peers, request, container)
    if request.node and request.node not in container.nodes:
        raise NotFoundError(f"container {container.tag!r} has no node {request.node!r}")
    chunk = await _ask(peers.get(container.task_set), request)
    if chunk.error:
        raise NotFoundError(chunk.error)
    return chunk


async def _read_earlier(
    tables: Tables, peers: Mapping[str, LogReader], request: LogRequest, container: Container
) -> LogChunk:
    """Read the log of an earlier incarnation: at the container's machine, or else at earlier ones."""
    if container.task_set in peers:
        chunk = await _ask(peers[container.task_set], request)
        if not chunk.error:
            return chunk
    return await _read_anywhere(tables, peers, request)


async def _read_anywhere(tables: Tables, peers: Mapping[str, LogReader], request: LogRequest) -> LogChunk:
    """Ask all machines; of several answers, use that of the incarnation that ended last."""
    asked = [
        peer
        for process, peer in peers.items()
        if (task_set := tables.task_sets.get(process)) is not None and task_set.kind is TaskSetKind.CONTAINER
    ]
    answers = await asyncio.gather(*(_ask(peer, request) for peer in asked), return_exceptions=True)
    found = _chunks(answers)
    if not found:
        tag = EndpointId.parse(request.id).tag
        reasons = {answer.error for answer in answers if isinstance(answer, LogChunk)}
        text = next(iter(sorted(reasons)), "no machine is connected that could have its logs")
        raise NotFoundError(
            f"there is no container {tag!r}" if tables.container(request.id) is None else text
        )
    return max(found, key=lambda chunk: chunk.ended or float("inf"))


def _chunks(answers: Iterable[LogChunk | BaseException]) -> list[LogChunk]:
    found = []
    for answer in answers:
        if isinstance(answer, LogChunk):
            if not answer.error:
                found.append(answer)
        elif not isinstance(answer, TaskSetAwayError):
            raise answer
    return found


async def _ask(peer: LogReader | None, request: LogRequest) -> LogChunk:
    tag = EndpointId.parse(request.id).tag
    if peer is None:
        raise TaskSetAwayError(f"container {tag!r} cannot be reached now")
    try:
        return await peer.read_log(
            request.id, request.node, offset=request.offset, limit=request.limit, query=request.query
        )
    except ControlError as error:
        raise TaskSetAwayError(f"container {tag!r} cannot be reached: {error}") from error


def _is_present(tables: Tables, request: LogRequest) -> bool:
    """Whether the present incarnation is requested, whatever the time of the machine's clock."""
    status = tables.container_live(request.id).status
    query = request.query
    return not query.previous and query.incarnation in ("", status.incarnation if status is not None else "")


def _owner_since(tables: Tables, id_: str) -> float:
    """When the owner was created: logs of a former user of the same name are not theirs."""
    user = tables.users.get(EndpointId.parse(id_).user)
    return user.created if user is not None else 0.0
