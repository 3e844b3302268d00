from __future__ import annotations

import pytest

from rce.guard.proxies import TrustedProxies

PROXIES = TrustedProxies(["10.0.0.0/8", "2001:db8::7"])


@pytest.mark.parametrize(
    ("peer", "forwarded", "address"),
    [
        (("192.0.2.1", 5), ["198.51.100.1"], "192.0.2.1"),
        (("10.0.0.1", 5), [], "10.0.0.1"),
        (("10.0.0.1", 5), ["192.0.2.9"], "192.0.2.9"),
        (("10.0.0.1", 5), ["127.0.0.1, 192.0.2.9"], "192.0.2.9"),
        (("10.0.0.1", 5), ["192.0.2.9, 10.3.3.3"], "192.0.2.9"),
        (("10.0.0.1", 5), ["192.0.2.9", "10.3.3.3"], "192.0.2.9"),
        (("10.0.0.1", 5), ["nonsense, 192.0.2.9"], "192.0.2.9"),
        (("10.0.0.1", 5), ["192.0.2.9, nonsense"], "10.0.0.1"),
        (("10.0.0.1", 5), ["\udcff"], "10.0.0.1"),
        (("::ffff:10.0.0.1", 5, 0, 0), ["192.0.2.9"], "192.0.2.9"),
        (("2001:db8::7", 5, 0, 0), ["2001:db8:1:2:3::4"], "2001:db8:1:2::/64"),
        (None, ["192.0.2.9"], ""),
        ("/run/socket", ["192.0.2.9"], ""),
    ],
)
def test_only_trusted_proxies_say_where_a_request_comes_from(
    peer: object, forwarded: list[str], address: str
) -> None:
    assert PROXIES.origin(peer, forwarded) == address


def test_a_proxy_that_is_no_address_is_refused() -> None:
    with pytest.raises(ValueError, match="proxy"):
        TrustedProxies(["proxy.example.org"])
