"""Answers requests to read logs: finds the requested incarnation of the container, and its log."""

from __future__ import annotations

from rce.control import LogChunk, LogStream, ReadLog
from rce.model import EndpointId, is_name
from rce_container.archive import Kept, LogArchive
from rce_container.environment.logs.files import ENVIRONMENT_LOG, ROSOUT_LOG
from rce_container.environment.logs.streams import letters_of
from rce_container.logs import Chunk, read_log, read_node_log


def read_for(archive: LogArchive, message: ReadLog, living: str) -> LogChunk:
    """Read the log that a message asks for. Blocks.

    Args:
        archive: All logs.
        message: The request.
        living: The mark of the container's present incarnation; empty without one.

    Raises:
        OSError: It cannot be read; ``FileNotFoundError`` if the log does not exist.
    """
    if message.node and not is_name(message.node):
        raise FileNotFoundError(f"there is no log of {message.node!r}")
    kept = _find(archive, message, living)
    chunk = _read(kept, message)
    record = kept.record
    return LogChunk(
        request=message.request,
        offset=chunk.offset,
        text=chunk.text,
        incarnation=record.incarnation_id,
        ended=record.ended,
        reason=record.reason,
    )


def _find(archive: LogArchive, message: ReadLog, living: str) -> Kept:
    current = archive.get(message.id, living) if living else None
    tag = EndpointId.parse(message.id).tag
    if message.query.incarnation:
        ended = [
            kept
            for kept in archive.ended(message.id)
            if kept.record.incarnation_id == message.query.incarnation
        ]
        found = current if living == message.query.incarnation else next(iter(ended), None)
        missing = f"the logs of that incarnation of container {tag} are not kept any more"
    elif current is not None and not message.query.previous and _is_owners(current, message):
        return current
    else:
        found = next(
            (kept for kept in archive.ended(message.id) if kept.record.incarnation_id != living), None
        )
        missing = f"no logs of an earlier life of container {tag} are kept here"
    if found is None or not _is_owners(found, message):
        raise FileNotFoundError(missing)
    return found


def _is_owners(kept: Kept, message: ReadLog) -> bool:
    """Whether an incarnation belongs to the requested user, and not to an earlier one of the same name."""
    return kept.record.began >= message.query.since


def _read(kept: Kept, message: ReadLog) -> Chunk:
    if message.node:
        letters = letters_of(message.query.streams, message.query.level)
        return read_node_log(kept.folder, message.node, message.offset, message.limit, letters)
    name = ROSOUT_LOG if LogStream.ROSOUT in message.query.streams else ENVIRONMENT_LOG
    return read_log(kept.folder, name, message.offset, message.limit)
