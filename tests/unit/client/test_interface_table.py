"""What reaches an interface that has the tag of an earlier one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import pytest
from support.client_types import STRING

from rce.protocol import DataMessage
from rce_client.interface_table import InterfaceTable
from rce_client.topics import Subscriber

if TYPE_CHECKING:
    from rce_client.interfaces import InterfaceOwner

NUMBER = "std_msgs/Int32"


def subscriber(message_type: str, got: list[Any], *, raw: bool = False) -> Subscriber[Any]:
    """Return one with a plain callback, which asks nothing of its connection."""
    owner = cast("InterfaceOwner", None)
    return Subscriber[Any](owner, "hear", message_type, raw=raw, callback=got.append, queue_size=8)


@pytest.mark.parametrize("raw", [False, True])
def test_a_message_for_a_removed_interface_does_not_reach_one_of_another_type(raw: bool) -> None:
    """The engine may have sent it before it learned of the removal."""
    table, got = InterfaceTable(), list[Any]()
    first = subscriber(STRING, got)
    table.add(first)
    assert table.withdraw(first)
    table.add(subscriber(STRING if raw else NUMBER, got, raw=raw))
    table.deliver(DataMessage("hear", STRING, {"data": "too late"}))
    assert got == []
    content: Any = b"fits" if raw else {"data": 1}
    table.deliver(DataMessage("hear", STRING if raw else NUMBER, content))
    assert got == [content]


def test_messages_of_two_types_reach_an_interface_that_is_the_first_with_its_tag() -> None:
    """Only a removed one gives reason to doubt: the type that the engine names may be an alias."""
    table, got = InterfaceTable(), list[Any]()
    table.add(subscriber(NUMBER, got))
    table.deliver(DataMessage("hear", STRING, {"data": "one"}))
    assert got == [{"data": "one"}]
