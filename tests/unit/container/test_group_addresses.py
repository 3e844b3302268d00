"""Which addresses containers of a group get, and what their /etc/hosts says."""

from __future__ import annotations

from ipaddress import IPv4Interface

import pytest

from rce_container.exceptions import NetworkError
from rce_container.network.addresses import choose, hosts_text, parse_address

TAKEN = {IPv4Interface("10.0.0.1/24"): "one", IPv4Interface("10.0.0.2/24"): "two"}


@pytest.mark.parametrize(
    ("text", "network"),
    [
        ("10.0.0.2", "10.0.0.0/24"),
        ("192.168.5.7/16", "192.168.0.0/16"),
        ("10.1.2.3/8", "10.0.0.0/8"),
        ("10.1.2.1/30", "10.1.2.0/30"),
    ],
)
def test_a_prefix_of_24_is_understood(text: str, network: str) -> None:
    address = parse_address(text)
    assert str(address.ip) == text.partition("/")[0]
    assert str(address.network) == network


@pytest.mark.parametrize(
    "text",
    ["", "x", "10.0.0", "10.0.0.256", "fe80::1", "10.0.0.1/33", "10.0.0.1/", "10.0.0.1/24/24", "10.0.0.1 "],
)
def test_what_is_no_address_is_told(text: str) -> None:
    with pytest.raises(NetworkError, match="is not an IPv4 address"):
        parse_address(text)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("10.0.0.1/31", "prefix from /8 to /30"),
        ("10.0.0.1/7", "prefix from /8 to /30"),
        ("10.0.0.0", "own or broadcast"),
        ("10.0.0.255", "own or broadcast"),
        ("127.0.0.5", "not one for hosts"),
        ("224.0.0.5", "not one for hosts"),
        ("0.0.0.7", "not one for hosts"),
        ("250.0.0.7", "not one for hosts"),
    ],
)
def test_an_address_that_no_container_can_have_is_told(text: str, why: str) -> None:
    with pytest.raises(NetworkError, match=why):
        parse_address(text)


def test_requested_address_is_granted_or_the_reason_given() -> None:
    assert choose("10.0.0.3", TAKEN) == IPv4Interface("10.0.0.3/24")
    with pytest.raises(NetworkError, match="belongs to container two of the same group"):
        choose("10.0.0.2", TAKEN)
    with pytest.raises(NetworkError, match=r"is in 10.0.1.0/24, but .* are in 10.0.0.0/24"):
        choose("10.0.1.2", TAKEN)
    with pytest.raises(NetworkError, match="are in"):
        choose("10.0.0.3/16", TAKEN)


def test_without_a_request_a_free_address_is_found() -> None:
    assert choose("", {}) == IPv4Interface("10.77.0.1/24")
    assert choose("", TAKEN) == IPv4Interface("10.0.0.3/24")
    both = {IPv4Interface("10.0.0.1/30"): "one", IPv4Interface("10.0.0.2/30"): "two"}
    with pytest.raises(NetworkError, match=r"no free address left in 10.0.0.0/30"):
        choose("", both)


def test_hosts_name_the_members_by_their_tags() -> None:
    assert hosts_text("box") == "127.0.0.1 localhost box\n"
    text = hosts_text("box", [("other", "10.0.0.2"), ("box", "10.0.0.1")])
    assert text == "127.0.0.1 localhost\n10.0.0.1 box\n10.0.0.2 other\n"
    assert len(hosts_text("x" * 100).split()[-1]) == 63
