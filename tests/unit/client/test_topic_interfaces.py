"""Publishers and subscribers of a program that makes mistakes: nothing else ends with them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import pytest
from support.client_types import STRING

from rce_client.topics import Publisher, Subscriber

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce.protocol import Frame
    from rce_client.interfaces import InterfaceOwner


class Owner:
    """A connection that notes what is sent; the interface is joined with a peer when the test says so."""

    knows_sources = True
    takes_single_frames = True

    def __init__(self) -> None:
        self.active = False
        self.sent: list[str | None] = []
        """The sources of the messages, empty for a statement about all sources."""

    def is_active(self, tag: str) -> bool:
        assert tag == "say"
        return self.active

    def post_data(self, tag: str, frames: Sequence[Frame], key: str | None = None) -> bool:
        assert tag == "say"
        assert frames
        self.sent.append(key)
        return True


@pytest.fixture
def owner() -> Owner:
    return Owner()


@pytest.fixture
def publisher(owner: Owner) -> Publisher[Any]:
    return Publisher[Any](cast("InterfaceOwner", owner), "say", STRING, raw=False)


@pytest.mark.parametrize("active", [False, True])
def test_latched_message_that_cannot_be_sent_is_not_kept(
    owner: Owner, publisher: Publisher[Any], *, active: bool
) -> None:
    """The program learns it at once, not when the interface is connected."""
    owner.active = active
    publisher.publish({"data": "map"}, latch="1")
    with pytest.raises(TypeError):
        publisher.publish({"data": object()}, latch="1")
    with pytest.raises(TypeError):
        publisher.publish({"data": object()}, latch="2")
    owner.sent.clear()
    publisher.on_active()
    assert owner.sent == ["1", ""]


def test_latched_message_that_was_changed_is_left_out(
    owner: Owner, publisher: Publisher[Any], caplog: pytest.LogCaptureFixture
) -> None:
    """The others are sent again, and the log names the interface."""
    message: dict[str, object] = {"data": "pose"}
    publisher.publish(message, latch="1")
    publisher.publish({"data": "map"}, latch="2")
    message["data"] = object()
    publisher.on_active()
    assert owner.sent == ["2", ""]
    assert "say" in caplog.text


@pytest.mark.parametrize("happen", [Publisher.on_active, Publisher.on_inactive, Publisher.on_lost])
def test_exceptions_of_demand_callbacks_are_logged(
    publisher: Publisher[Any], happen: Callable[[Publisher[Any]], None], caplog: pytest.LogCaptureFixture
) -> None:
    def fail(needed: bool) -> None:
        raise ValueError(f"camera {needed}")

    publisher.watch_demand(fail)
    happen(publisher)
    assert "ValueError: camera" in caplog.text


def test_exceptions_of_latch_listeners_are_logged(owner: Owner, caplog: pytest.LogCaptureFixture) -> None:
    class Listener:
        def received_latched(self, message: object, source: str) -> None:
            raise AssertionError

        def keep_latched(self, sources: Sequence[str]) -> None:
            raise ValueError(f"kept {sources}")

    subscriber = Subscriber[Any](
        cast("InterfaceOwner", owner),
        "hear",
        STRING,
        raw=False,
        callback=print,
        queue_size=1,
        latches=Listener(),
    )
    subscriber.keep_latched(("1",))
    assert "ValueError: kept" in caplog.text
