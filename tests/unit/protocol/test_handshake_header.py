from __future__ import annotations

import json

import pytest

from rce.protocol.exceptions import HandshakeError
from rce.protocol.http import Credentials, master_reply, read_credentials, read_master_request

WHO = "userID=u&robotID=r"
DIGEST = "ab" * 32
ENTRY = "userID=u&version=20130902"


def test_token_in_header() -> None:
    assert read_credentials(WHO, ["Bearer rce_abc-_"]) == Credentials("u", "r", token="rce_abc-_")


def test_digest_in_header() -> None:
    assert read_credentials(WHO, [f"bearer {DIGEST.upper()}"]) == Credentials("u", "r", password=DIGEST)


def test_digest_in_url_still_works() -> None:
    assert read_credentials(f"{WHO}&password={DIGEST}") == Credentials("u", "r", password=DIGEST)


@pytest.mark.parametrize(
    ("query", "headers", "status"),
    [
        (f"{WHO}&password={DIGEST}", ["Bearer x"], 400),
        ("userID=u", ["Bearer x"], 400),
        (WHO, ["Basic x"], 401),
        (WHO, ["Bearer "], 401),
        (WHO, ["Bearer \udce9"], 401),
        (WHO, ["Bearer x", "Bearer x"], 401),
        (WHO, [f"Bearer {'x' * 300}"], 401),
        (WHO, [], 400),
    ],
)
def test_header_that_is_not_understood(query: str, headers: list[str], status: int) -> None:
    with pytest.raises(HandshakeError) as caught:
        read_credentials(query, headers)
    assert caught.value.status == status
    assert DIGEST not in caught.value.reason


def test_only_who_asks_is_told_of_the_header() -> None:
    """A client of an earlier release gets the answer that it always got."""
    old, new = read_master_request(ENTRY), read_master_request(f"{ENTRY}&auth=bearer")
    assert json.loads(master_reply(old, "ws://h/", header=True)) == {"url": "ws://h/"}
    assert json.loads(master_reply(new, "ws://h/", header=True)) == {"url": "ws://h/", "auth": "bearer"}
    assert json.loads(master_reply(new, "ws://h/")) == {"url": "ws://h/"}
