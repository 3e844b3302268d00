"""The protocol page says what the code does."""

from __future__ import annotations

import ast
import hashlib
import json
import re
from pathlib import Path

import pytest

from rce.model.names import MAX_NAME_LENGTH, Form, Role
from rce.model.requests import ConfigureComponents, ConfigureConnections
from rce.protocol.http import CURRENT_VERSION, MIN_VERSION, read_credentials, read_master_request
from rce.protocol.limits import DEFAULT_LIMITS, MAX_MESSAGE_ID_LENGTH
from rce.protocol.messages import TYPES, DataMessage
from rce.protocol.stream import Fault, ProtocolStream

PAGE = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text()
BLOCKS = [json.loads(block) for block in re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)]
MESSAGES = [block for block in BLOCKS if "type" in block]


@pytest.mark.parametrize("message", MESSAGES, ids=[str(number) for number in range(len(MESSAGES))])
def test_every_example_is_a_message(message: dict[str, object]) -> None:
    stream = ProtocolStream(TYPES)
    text = json.dumps(message)
    events = stream.feed(text, 0.0)
    for id_ in re.findall(r'\*": "([0-9a-f]{32})"', text):
        events += stream.feed(id_.encode() + b"bytes", 0.0)
    (event,) = events
    assert not isinstance(event, Fault)
    if isinstance(event, ConfigureComponents | ConfigureConnections):
        assert event.faults == ()
    if isinstance(event, DataMessage) and "*" in text:
        assert b"bytes" in ([event.msg] if isinstance(event.msg, memoryview) else event.msg.values())


def test_every_type_has_an_example() -> None:
    assert {message["type"] for message in MESSAGES} == set(TYPES)


def test_requests_of_the_page_are_accepted() -> None:
    queries = re.findall(r"^GET \S+\?(\S+)$", PAGE, re.MULTILINE)
    assert read_master_request(queries[0]).version == CURRENT_VERSION
    assert read_credentials(queries[1]).password == hashlib.sha256(b"testUser").hexdigest()
    assert MIN_VERSION in PAGE


def test_numbers_of_the_page_are_those_of_the_code() -> None:
    limits = DEFAULT_LIMITS
    for row in (
        f"| text frame | {limits.max_text // 2**20} MiB |",
        f"| binary frame | {limits.max_binary // 2**20} MiB |",
        f"| {limits.max_elements:,} objects, lists and members of objects; {limits.max_values:,} values |",
        f"{limits.max_depth} levels",
        f"| {limits.max_references} |",
        f"{limits.max_pending}, with {limits.max_pending_bytes // 2**20} MiB together",
        f"| {limits.expiry:g} s |",
        f"| {MAX_NAME_LENGTH} characters |",
        f"| {MAX_MESSAGE_ID_LENGTH} characters |",
    ):
        assert row in PAGE


def test_page_names_every_role_and_form() -> None:
    for word in (*Role, *Form):
        assert f"| `{word.value}` |" in PAGE


def test_program_of_the_page_is_python() -> None:
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert ast.parse(program)
