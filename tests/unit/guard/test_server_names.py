from __future__ import annotations

import socket

import pytest

from rce.web.origin import ServerNames

NAMES = ServerNames("cloud-1", ["Fleet.Example.org"])


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "localhost:9000",
        "LOCALHOST.",
        "127.0.0.1:9000",
        "[::1]:9000",
        "203.0.113.9",
        "cloud-1:1",
        "fleet.example.org",
        socket.gethostname(),
    ],
)
def test_own_names_and_addresses_are_known(host: str) -> None:
    assert NAMES.refusal(host) is None


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:9000",
        "localhost.evil.example",
        "127.0.0.1.evil.example:9000",
        "user@localhost",
        "localhost:9000:1",
        "[localhost]",
        "::1",
        "a b",
        "",
    ],
)
def test_other_names_are_refused_with_remedy(host: str) -> None:
    assert "--public-name" in (NAMES.refusal(host) or "")
