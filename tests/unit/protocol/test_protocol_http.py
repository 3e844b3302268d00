"""The two HTTP requests with which a client comes in."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.protocol.exceptions import HandshakeError
from rce.protocol.http import Credentials, MasterRequest, master_reply, read_credentials, read_master_request

HASH = "0123456789abcdef" * 4


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("", 400),
        ("userID=u", 400),
        ("version=20130902", 400),
        ("userID=u&userID=v&version=20130902", 400),
        ("userID=u&version=20130902&version=20130902", 400),
        ("userID=&version=20130902", 400),
        ("userID=9u&version=20130902", 400),
        ("userID=u&version=", 400),
        ("userID=u&version=new", 400),
        ("userID=u&version=%D9%A1", 400),
        ("userID=%ff&version=20130902", 400),
        ("userID=u&version=" + "1" * 5000, 400),
        ("&".join(f"a{n}=1" for n in range(100)), 400),
        ("userID=u&version=20130414", 410),
        ("userID=u&version=0", 410),
        ("userID=u&version=20130903", 501),
    ],
)
def test_wrong_master_request(query: str, status: int) -> None:
    with pytest.raises(HandshakeError) as caught:
        read_master_request(query)
    assert caught.value.status == status
    assert caught.value.reason


@pytest.mark.parametrize(
    ("version", "body"),
    [
        ("20130902", {"url": "ws://h:9010/"}),
        ("20130901", {"url": "ws://h:9010/", "current": "20130902"}),
        ("20130415", {"url": "ws://h:9010/", "current": "20130902"}),
    ],
)
def test_master_reply(version: str, body: dict[str, str]) -> None:
    request = read_master_request(f"version={version}&userID=testUser&other=1")
    assert request == MasterRequest("testUser", version)
    assert json.loads(master_reply(request, "ws://h:9010/")) == body


def test_credentials_are_read_and_hidden() -> None:
    credentials = read_credentials(f"userID=u&robotID=r&password={HASH.upper()}")
    assert credentials == Credentials("u", "r", HASH)
    assert HASH not in repr(credentials)


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("", 400),
        (f"userID=u&password={HASH}", 400),
        (f"userID=u&robotID=r&robotID=r&password={HASH}", 400),
        (f"userID=u&robotID=a%2Fb&password={HASH}", 400),
        ("userID=u&robotID=r", 400),
        ("userID=u&robotID=r&password=", 401),
        ("userID=u&robotID=r&password=secret", 401),
    ],
)
def test_wrong_handshake(query: str, status: int) -> None:
    with pytest.raises(HandshakeError) as caught:
        read_credentials(query)
    assert caught.value.status == status


@given(st.text())
def test_any_query_is_read_or_refused(query: str) -> None:
    readers: tuple[Callable[[str], MasterRequest | Credentials], ...] = (
        read_master_request,
        read_credentials,
    )
    for read in readers:
        with contextlib.suppress(HandshakeError):
            assert read(query).user in query
