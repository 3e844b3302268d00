from __future__ import annotations

import ipaddress
import socket

import pytest

from rce.link import address
from rce.link.address import in_url, is_any, own_address


async def test_local_master_does_not_mislead_other_machines(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A master on the same machine does not make others look on theirs."""
    ways = {"127.0.0.1": "127.0.0.1", "10.0.0.9": "10.0.0.2", "192.0.2.1": "10.0.0.7"}

    async def towards(host: str, _: int) -> str | None:
        return ways.get(host)

    monkeypatch.setattr(address, "_address_towards", towards)
    assert await own_address("127.0.0.1", 8080) == "10.0.0.7"
    assert await own_address("10.0.0.9", 8080) == "10.0.0.2"
    assert await own_address("nowhere.example", 8080) == "10.0.0.7"
    ways.clear()
    assert await own_address("127.0.0.1", 8080) == "127.0.0.1"


async def test_the_address_is_one_of_this_machine() -> None:
    found = await own_address("127.0.0.1", 8080)
    family = socket.AF_INET6 if ipaddress.ip_address(found).version == 6 else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.bind((found, 0))


def test_hosts_in_urls_and_hosts_that_are_all() -> None:
    assert (in_url("::1"), in_url("10.0.0.1")) == ("[::1]", "10.0.0.1")
    assert [is_any(host) for host in ("", "0.0.0.0", "::", "127.0.0.1")] == [True, True, True, False]
