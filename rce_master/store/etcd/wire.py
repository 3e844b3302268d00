"""Messages of etcd's JSON gateway: keys and values in base64, 64-bit numbers as texts. Pure.

The layout is that of ``etcdserverpb.KV`` and ``Lease`` in protobuf's JSON form, which etcd 3.4 and later have
below ``/v3``. A number of 0 and an empty text are left out of answers.
"""

from __future__ import annotations

import binascii
import json
from base64 import b64decode, b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeAlias

Message: TypeAlias = "dict[str, Any]"
"""A JSON object."""


class WireError(Exception):
    """An answer is not of etcd's gateway."""


class Subject(Enum):
    """What of a key a condition compares."""

    CREATED = "create_revision"
    """The revision at which it was created; 0 while it does not exist."""
    MODIFIED = "mod_revision"
    """The revision at which it was last written; 0 while it does not exist."""
    VALUE = "value"


_TARGETS = {Subject.CREATED: "CREATE", Subject.MODIFIED: "MOD", Subject.VALUE: "VALUE"}


@dataclass(frozen=True, slots=True)
class Condition:
    """A transaction is done if all its conditions hold."""

    key: str
    subject: Subject
    equals: int | bytes
    """A value is bytes, a revision a number."""


@dataclass(frozen=True, slots=True)
class Put:
    """Write a key."""

    key: str
    value: bytes
    lease: int = 0
    """The key is removed when this lease ends; 0: never."""


@dataclass(frozen=True, slots=True)
class Delete:
    """Remove a key, if it exists."""

    key: str


@dataclass(frozen=True, slots=True)
class Record:
    """A key as etcd keeps it."""

    key: str
    value: bytes
    created: int
    """Revision."""
    modified: int
    """Revision."""
    lease: int = 0


@dataclass(frozen=True, slots=True)
class Page:
    """Records of a range of keys, in their order."""

    records: tuple[Record, ...]
    revision: int
    """The revision of the whole store at which they were read."""
    more: bool
    """Whether the range has further keys."""
    count: int = 0
    """All keys of the range, also those that were not asked for by when they were written."""


@dataclass(frozen=True, slots=True)
class Change:
    """A write that a watch tells of."""

    key: str
    value: bytes | None
    """None: the key was removed."""
    revision: int


@dataclass(frozen=True, slots=True)
class Watched:
    """An answer of a watch."""

    changes: tuple[Change, ...]
    """In the order of the writes."""
    revision: int
    """Of the last change; 0: there is none."""
    compacted: int = 0
    """Not 0: what was to be watched was compacted away, up to this revision."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer to a transaction."""

    done: bool
    """Whether its conditions held, and it was written."""
    revision: int
    found: tuple[Record, ...] = ()
    """The keys that were asked for if it was not done."""


@dataclass(frozen=True, slots=True)
class GatewayFault:
    """An error of etcd: gRPC's code and etcd's text."""

    code: int
    text: str


def end_of(prefix: str) -> bytes:
    """Return the end of the range of all keys that begin with a prefix."""
    key = bytearray(prefix.encode())
    while key and key[-1] == 0xFF:  # noqa: PLR2004 - the greatest byte
        key.pop()
    if not key:
        return b"\0"
    key[-1] += 1
    return bytes(key)


GROUP = 2000
"""Operations of one level of a transaction. etcd counts each level for itself, from the outermost one on:
those of a group and the number of groups together stay below what it must allow."""


def range_request(
    prefix: str,
    *,
    after: str = "",
    limit: int = 0,
    revision: int = 0,
    keys_only: bool = False,
    written_after: int = 0,
) -> Message:
    """Ask for keys with a prefix.

    Args:
        prefix: How they begin.
        after: Only those behind this key.
        limit: At most so many; 0: all.
        revision: The state to read; 0: the newest, agreed on by a majority.
        keys_only: Leave the values out.
        written_after: Only keys that were written after this revision.
    """
    begin = after.encode() + b"\0" if after else prefix.encode()
    message: Message = {"key": _base64(begin), "range_end": _base64(end_of(prefix))}
    if limit:
        message["limit"] = str(limit)
    if revision:
        message["revision"] = str(revision)
    if keys_only:
        message["keys_only"] = True
    if written_after:
        message["min_mod_revision"] = str(written_after + 1)
    return message


def watch_request(prefix: str, revision: int) -> Message:
    """Ask for what is written to keys with a prefix.

    Args:
        prefix: How they begin.
        revision: The first one to tell of.
    """
    return {
        "create_request": {
            "key": _base64(prefix.encode()),
            "range_end": _base64(end_of(prefix)),
            "start_revision": str(revision),
        }
    }


def get_request(key: str) -> Message:
    """Ask for one key."""
    return {"key": _base64(key.encode())}


def txn_request(
    conditions: Sequence[Condition], operations: Sequence[Put | Delete], otherwise: Sequence[str] = ()
) -> Message:
    """Ask for a transaction.

    Args:
        conditions: It is done if all of them hold.
        operations: What to write; no key twice. Many are grouped in transactions within this one.
        otherwise: Keys to read if it is not done.
    """
    return {
        "compare": [_condition(one) for one in conditions],
        "success": _grouped([_operation(one) for one in operations]),
        "failure": [{"request_range": get_request(key)} for key in otherwise],
    }


def grant_request(ttl: int) -> Message:
    """Ask for a lease of so many seconds."""
    return {"TTL": str(ttl)}


def lease_request(lease: int) -> Message:
    """Ask for a lease to be renewed or revoked."""
    return {"ID": str(lease)}


def read_page(answer: Message) -> Page:
    """Read the answer to a range request.

    Raises:
        WireError: It is not one.
    """
    try:
        more, count = bool(answer.get("more", False)), int(answer.get("count", 0))
        return Page(_records(answer), _revision(answer), more, count)
    except _BROKEN as error:
        raise WireError(f"not an answer to a range request: {error!r}") from error


def read_outcome(answer: Message) -> Outcome:
    """Read the answer to a transaction.

    Raises:
        WireError: It is not one.
    """
    try:
        done = bool(answer.get("succeeded", False))
        parts = [] if done else answer.get("responses", [])
        found = [record for part in parts for record in _records(part["response_range"])]
        return Outcome(done, _revision(answer), tuple(found))
    except _BROKEN as error:
        raise WireError(f"not an answer to a transaction: {error!r}") from error


def read_lease(answer: Message) -> tuple[int, int]:
    """Read a granted or renewed lease.

    Returns:
        Its number, and how many seconds it lasts from now; 0 if it has ended.

    Raises:
        WireError: It is not a lease.
    """
    try:
        lease = answer.get("result", answer)
        return int(lease["ID"]), int(lease.get("TTL", 0))
    except _BROKEN as error:
        raise WireError(f"not a lease: {error!r}") from error


def read_watched(line: bytes) -> Watched:
    """Read a line of the answer to a watch.

    Raises:
        WireError: It is not etcd's answer, or the watch has ended.
    """
    try:
        result = json.loads(line)["result"]
        compacted = int(result.get("compact_revision", 0))
        if result.get("canceled") and not compacted:
            raise WireError(f"etcd ended the watch: {result.get('cancel_reason', 'no reason given')}")
        changes = tuple(map(_change, result.get("events", [])))
        return Watched(changes, changes[-1].revision if changes else 0, compacted)
    except _BROKEN as error:
        raise WireError("not an answer of etcd to a watch") from error


def as_it_is(answer: Message) -> Message:
    """Read an answer of which nothing is needed."""
    return answer


def read_fault(body: bytes) -> GatewayFault | None:
    """Read an error, from the answer to a request or from a stream of answers.

    Returns:
        None if the answer is not an error of etcd.
    """
    try:
        answer = json.loads(body)
        inner = answer.get("error")
        fault = inner if isinstance(inner, dict) else answer
        code = fault.get("code", fault.get("grpc_code"))
        text = fault.get("message") or fault.get("error")
        return GatewayFault(int(code), str(text)) if code is not None and text else None
    except (ValueError, AttributeError, TypeError):
        return None


def read_faults(answer: Message) -> tuple[str, ...]:
    """Read what a member tells of faults of itself and of the cluster, such as ``memberID:5 alarm:NOSPACE``.

    Raises:
        WireError: It is not the status of a member.
    """
    faults = answer.get("errors", [])
    if "header" not in answer or not isinstance(faults, list):
        raise WireError("not the status of a member")
    return tuple(map(str, faults))


def read_version(body: bytes) -> tuple[int, int]:
    """Read the major and minor version of a server.

    Raises:
        WireError: It is not etcd's answer.
    """
    try:
        major, minor, *_ = json.loads(body)["etcdserver"].split(".")
        return int(major), int(minor)
    except _BROKEN as error:
        raise WireError("not an answer of etcd") from error


_BROKEN = (KeyError, ValueError, TypeError, AttributeError, binascii.Error)
"""What reading a message of another form raises."""


def _base64(value: bytes) -> str:
    return b64encode(value).decode()


def _condition(condition: Condition) -> Message:
    equals = condition.equals
    return {
        "key": _base64(condition.key.encode()),
        "target": _TARGETS[condition.subject],
        "result": "EQUAL",
        condition.subject.value: _base64(equals) if isinstance(equals, bytes) else str(equals),
    }


def _operation(operation: Put | Delete) -> Message:
    if isinstance(operation, Delete):
        return {"request_delete_range": get_request(operation.key)}
    put = {"key": _base64(operation.key.encode()), "value": _base64(operation.value)}
    if operation.lease:
        put["lease"] = str(operation.lease)
    return {"request_put": put}


def _grouped(operations: list[Message]) -> list[Message]:
    if len(operations) <= GROUP:
        return operations
    return [
        {"request_txn": {"success": operations[begin : begin + GROUP]}}
        for begin in range(0, len(operations), GROUP)
    ]


def _records(answer: Message) -> tuple[Record, ...]:
    return tuple(
        Record(
            key=b64decode(each["key"]).decode(),
            value=b64decode(each.get("value", "")),
            created=int(each["create_revision"]),
            modified=int(each["mod_revision"]),
            lease=int(each.get("lease", 0)),
        )
        for each in answer.get("kvs", [])
    )


def _change(event: Message) -> Change:
    found = event["kv"]
    value = None if event.get("type") == "DELETE" else b64decode(found.get("value", ""))
    return Change(b64decode(found["key"]).decode(), value, int(found["mod_revision"]))


def _revision(answer: Message) -> int:
    return int(answer["header"]["revision"])
