from __future__ import annotations

import socket

import pytest

from rce.web.origin import ServerNames, is_foreign

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


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("https://fleet.example.org", "fleet.example.org"),
        ("https://Fleet.example.org", "fleet.example.org:443"),
        ("https://fleet.example.org:443", "fleet.example.org"),
        ("http://192.0.2.2", "192.0.2.2"),
        ("http://192.0.2.2:9000", "192.0.2.2:9000"),
        ("http://[::1]:9000", "[::1]:9000"),
        ("https://[fd00::2]", "[fd00::2]"),
    ],
)
def test_pages_of_the_server_itself_are_not_foreign(origin: str, host: str) -> None:
    assert not is_foreign(origin, host)


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("https://evil.example", "fleet.example.org"),
        ("http://fleet.example.org:8000", "fleet.example.org"),
        ("http://fleet.example.org", "fleet.example.org:443"),
        ("http://fleet.example.org:8000", "fleet.example.org:9000"),
        ("http://fleet.example.org.evil.example", "fleet.example.org"),
        ("http://user@fleet.example.org", "fleet.example.org"),
        ("null", "fleet.example.org"),
        ("file://", ""),
        ("http://[::1", "[::1"),
        ("", ""),
    ],
)
def test_pages_of_other_sites_are_foreign(origin: str, host: str) -> None:
    assert is_foreign(origin, host)
