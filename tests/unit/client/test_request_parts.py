"""Large requests are sent in parts that the engine takes."""

from __future__ import annotations

import pytest

from rce.model import (
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    RemoveNode,
    Request,
)
from rce_client.desired import Desired
from rce_client.parts import parts_of

LINKS = tuple(Connection(tag_a=f"a/x{number}", tag_b=f"b/x{number}") for number in range(7))
NODES = tuple(RemoveNode(container="c", tag=f"n{number}") for number in range(3))


@pytest.mark.parametrize(
    "request_",
    [CreateContainer(tag="c"), ConfigureConnections(connect=LINKS), ConfigureComponents(remove_nodes=NODES)],
)
def test_a_small_request_stays_as_it_is(request_: Request) -> None:
    assert list(parts_of(request_, 7)) == [request_]


def test_parts_of_a_large_request_do_the_same_in_order() -> None:
    whole = ConfigureConnections(disconnect=LINKS[:3], connect=LINKS[3:])
    parts = list(parts_of(whole, 2))
    assert parts == [
        ConfigureConnections(disconnect=LINKS[:2]),
        ConfigureConnections(disconnect=LINKS[2:3], connect=LINKS[3:4]),
        ConfigureConnections(connect=LINKS[4:6]),
        ConfigureConnections(connect=LINKS[6:]),
    ]
    at_once, one_by_one = Desired(), Desired()
    at_once.apply(whole)
    for part in parts:
        one_by_one.apply(part)
    assert at_once.restore() == one_by_one.restore()
