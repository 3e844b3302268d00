"""What a leading master believes of requests that stand-bys forward."""

from __future__ import annotations

import pytest

from rce.config import Secret
from rce_master.http.forwarded import ForwardingKey

KEY = ForwardingKey(Secret("k" * 32))


@pytest.mark.parametrize("address", ["10.0.0.7", "2001:db8::1", ""])
def test_the_address_arrives(address: str) -> None:
    assert KEY.read(KEY.sign(address, 4), 4) == address


@pytest.mark.parametrize(
    "value",
    [
        "",
        " ",
        "10.0.0.7 4",
        "10.0.0.7 4 00",
        "10.0.0.7 4 \udcff",
        KEY.sign("10.0.0.7", 3),
        ForwardingKey(Secret("x" * 32)).sign("10.0.0.7", 4),
        KEY.sign("10.0.0.7", 4).replace("10.0.0.7", "10.0.0.8"),
        KEY.sign("10.0.0.7", 3).replace(" 3 ", " 4 "),
    ],
)
def test_nothing_else_is_believed(value: str) -> None:
    assert KEY.read(value, 4) is None
