"""Messages of a robot's topics go to the cloud once somebody there hears them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from rce_client import Serialized
from rce_client.ros_bridge.bridge import SHOWN_NAMES, Downlink, Uplink, listed
from rce_client.topics import Publisher

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.protocol.codec import Frame

TAG, STRING = "pose", "std_msgs/String"


class PlayedWay:
    """A connection with one interface, which is active when the test says so."""

    knows_sources = True
    takes_single_frames = False

    def __init__(self) -> None:
        self.active: dict[str, bool] = {}
        self.sent: list[tuple[str, str]] = []

    def is_active(self, tag: str) -> bool:
        return self.active.get(tag, False)

    def post_data(
        self, tag: str, frames: Sequence[Frame], key: str | None = None, queue_size: int | None = None
    ) -> bool:
        message = json.loads(frames[0])
        data = message["data"]
        if message["type"] == "LT":
            self.sent.append(("LT", ",".join(data.get("sources", ()))))
        else:
            self.sent.append((data.get("latch", ""), bytes(frames[1])[32:].decode()))  # type: ignore[arg-type]  # a binary frame
        return True

    def join(self, publisher: Publisher[Serialized], *, active: bool = True) -> None:
        self.active[TAG] = active
        if active:
            publisher.on_active()


def uplink() -> tuple[PlayedWay, Publisher[Serialized], Uplink]:
    way: Any = PlayedWay()
    publisher = Publisher[Serialized](way, TAG, STRING, raw=True)
    return way, publisher, Uplink(way, publisher)


def test_what_comes_too_early_is_not_sent_unless_it_is_latched() -> None:
    way, publisher, link = uplink()
    link.received(b"pose 1")
    link.received_latched(b"map 1", "http://a")
    link.received_latched(b"map 2", "http://a")
    link.received_latched(b"sign", "http://b")
    assert way.sent == []
    way.join(publisher)
    assert way.sent == [("1", "map 2"), ("2", "sign"), ("LT", "1,2")]
    link.received(b"pose 2")
    link.received_latched(b"map 3", "http://a")
    assert way.sent[3:] == [("", "pose 2"), ("1", "map 3")]


def test_what_is_latched_is_said_again_when_the_peer_is_back() -> None:
    way, publisher, link = uplink()
    way.join(publisher)
    link.received_latched(b"map", "http://a")
    way.join(publisher, active=False)
    link.received(b"pose")
    way.sent.clear()
    way.join(publisher)
    assert way.sent == [("1", "map"), ("LT", "1")]


def test_a_publisher_that_ends_takes_its_message_back() -> None:
    way, publisher, link = uplink()
    way.join(publisher)
    for name in ("a", "b"):
        link.received_latched(name.encode(), f"http://{name}")
    link.source_ended("http://a")
    assert way.sent[-1] == ("LT", "2")
    link.received_latched(b"a is back", "http://a")
    assert way.sent[-1] == ("3", "a is back")


def test_an_engine_that_knows_no_sources_is_told_of_none() -> None:
    way, publisher, link = uplink()
    way.knows_sources = False
    link.received_latched(b"map", "http://a")
    way.join(publisher)
    link.source_ended("http://a")
    assert way.sent == [("", "map")]


class PlayedTopic:
    """A topic of the robot's graph."""

    def __init__(self) -> None:
        self.latched: dict[str, bytes] = {}
        self.published: list[bytes] = []

    def publish_serialized(self, payload: bytes, latch: bool = False, source: str = "") -> None:
        self.published.append(payload)
        if latch:
            self.latched[source] = payload

    def unlatch(self, source: str = "") -> None:
        del self.latched[source]


def test_what_the_cloud_latches_is_latched_at_the_robot() -> None:
    topic: Any = PlayedTopic()
    link = Downlink(topic)
    link.received(b"pose")
    for source in ("5.1", "5.2"):
        link.received_latched(source.encode(), source)
    assert topic.published == [b"pose", b"5.1", b"5.2"]
    link.keep_latched(("5.2", "5.3"))
    assert topic.latched == {"5.2": b"5.2"}


def test_a_message_names_some_of_many_interfaces() -> None:
    names = [f"pose{number}" for number in range(SHOWN_NAMES + 2)]
    assert listed(names[:2]) == "pose0, pose1"
    assert listed(names[:SHOWN_NAMES]).endswith(f", pose{SHOWN_NAMES - 1}")
    assert listed(names).endswith(f", pose{SHOWN_NAMES - 1} and 2 more")
