"""What reaches an interface that has the tag of an earlier one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import pytest
from support.client_types import STRING

from rce.protocol import DataMessage
from rce_client.early_messages import MAX_SOURCES, MAX_TOPICS, EarlyMessages
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


def test_latched_messages_do_not_make_room_for_others() -> None:
    """The engine sends a latched message once; a station that starts late has many topics."""
    table, got = InterfaceTable(), list[Any]()
    table.deliver(DataMessage("hear", STRING, {"data": "map"}, latch="1"))
    for number in range(2 * MAX_TOPICS):
        table.deliver(DataMessage(f"topic{number}", STRING, {"data": "pose"}))
    table.add(subscriber(STRING, got))
    assert got == [{"data": "map"}]


@pytest.mark.parametrize(("latch", "most"), [("1", MAX_SOURCES), ("", MAX_TOPICS)])
def test_early_messages_are_bounded(latch: str, most: int, caplog: pytest.LogCaptureFixture) -> None:
    """The newest are kept, of each source the last; that others are dropped is logged once."""
    early = EarlyMessages()
    for number in range(most + 9):
        for data in (b"old", b"new"):
            early.keep(DataMessage(f"topic{number}", STRING, data, latch=latch))
    kept = [early.take(f"topic{number}") for number in range(most + 9)]
    assert kept[:9] == [[]] * 9
    assert [message.msg for (message,) in kept[9:]] == [b"new"] * most
    assert len(caplog.records) == 1


@pytest.mark.parametrize("latch", ["1", ""])
def test_early_messages_are_bounded_in_bytes(latch: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is parsed counts by its memory; a larger message is kept alone, but for the other kind."""
    monkeypatch.setattr("rce_client.early_messages.MAX_BYTES", 64_000)
    early = EarlyMessages()
    early.keep(DataMessage("small", STRING, b"", latch=latch))
    early.keep(DataMessage("other", STRING, b"", latch="" if latch else "1"))
    early.keep(DataMessage("parsed", STRING, {"list": [{} for _ in range(1000)]}, latch=latch))
    assert not early.take("small")
    early.keep(DataMessage("binary", STRING, memoryview(bytes(64_001)), latch=latch))
    assert not early.take("parsed")
    assert early.take("binary")
    assert early.take("other")
