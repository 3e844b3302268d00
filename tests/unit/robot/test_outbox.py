"""The outgoing queue of one robot."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.aio.queues import OverflowPolicy
from rce_robot.doors.base import Queued
from rce_robot.doors.client.outbox import Outbox, OutboxLimits
from rce_robot.outgoing import LatchedDelivery, Outgoing


def message(text: str, extra: int = 0) -> Outgoing:
    return Outgoing(text.encode(), ((b"", bytes(extra)),) if extra else ())


def text_of(item: Queued) -> str:
    rendered = item.render()
    assert isinstance(rendered, Outgoing)
    return bytes(rendered.text).decode()


def drain(outbox: Outbox) -> list[str]:
    texts = []
    while (item := outbox.pop()) is not None:
        texts.append(text_of(item))
    return texts


def test_keeps_the_order_within_an_interface() -> None:
    outbox = Outbox()
    for index in range(5):
        assert outbox.put_data("pose", message(str(index)))
    assert drain(outbox) == list("01234")
    assert not outbox


def test_control_goes_before_data() -> None:
    outbox = Outbox()
    outbox.put_data("pose", message("data"))
    outbox.put_control(message("control"))
    outbox.put_state("pose", message("state"))
    assert drain(outbox) == ["state", "control", "data"]


def test_a_newer_state_replaces_an_unsent_one() -> None:
    outbox = Outbox()
    outbox.put_state("pose", message("on"))
    outbox.put_state("scan", message("scan on"))
    outbox.put_state("pose", message("off"))
    assert drain(outbox) == ["off", "scan on"]


def test_unsent_states_are_counted() -> None:
    """A robot that does not read may have interfaces made and removed as long as it likes."""
    outbox = Outbox()
    for number in range(10_000):
        outbox.put_state(f"tag{number}", message("inactive"))
        outbox.put_state(f"tag{number}", message("active"))
    assert outbox.bytes >= 10_000 * 200
    for _ in range(5000):
        outbox.pop()
    half = outbox.bytes
    assert half >= 5000 * 200
    outbox.put_state("tag9999", message("active"))
    assert outbox.bytes == half
    outbox.clear()
    assert outbox.bytes == 0
    outbox.put_state("tag", message("active"))
    outbox.pop()
    assert outbox.bytes == 0


def test_a_full_topic_forgets_its_oldest_and_counts() -> None:
    outbox = Outbox(OutboxLimits(queue_messages=3))
    for index in range(10):
        assert outbox.put_data("image", message(str(index)))
    assert outbox.dropped == {"image": 7}
    assert drain(outbox) == list("789")


def test_a_full_topic_leaves_others_alone() -> None:
    outbox = Outbox(OutboxLimits(queue_bytes=1000))
    outbox.put_data("pose", message("pose"))
    for _ in range(100):
        outbox.put_data("image", message("image", 400))
    assert outbox.dropped == {"image": 98}
    assert sorted(drain(outbox)) == ["image", "image", "pose"]


def test_takes_one_message_however_large() -> None:
    outbox = Outbox(OutboxLimits(queue_bytes=10, total_bytes=10))
    assert outbox.put_data("image", message("first", 1000))
    assert outbox.put_data("image", message("second", 1000))
    assert drain(outbox) == ["second"]


def test_a_full_service_refuses() -> None:
    outbox = Outbox(OutboxLimits(queue_messages=2))
    assert outbox.put_data("map", message("1"), OverflowPolicy.REFUSE)
    assert outbox.put_data("map", message("2"), OverflowPolicy.REFUSE)
    assert not outbox.put_data("map", message("3"), OverflowPolicy.REFUSE)
    assert drain(outbox) == ["1", "2"]
    assert not outbox.dropped


def test_the_total_is_bounded_and_the_fattest_topic_pays() -> None:
    outbox = Outbox(OutboxLimits(queue_bytes=1000, total_bytes=1500))
    outbox.put_data("service", message("s", 400), OverflowPolicy.REFUSE)
    outbox.put_data("pose", message("p"))
    for tag in ("left", "right"):
        for _ in range(4):
            outbox.put_data(tag, message(tag, 200))
    assert outbox.bytes <= 1500
    assert "pose" not in outbox.dropped
    assert "service" not in outbox.dropped


def test_full_control_lane_says_so() -> None:
    outbox = Outbox(OutboxLimits(control_messages=2))
    assert outbox.put_control(message("1"))
    assert outbox.put_control(message("2"))
    assert not outbox.put_control(message("3"))


def test_small_messages_pass_large_ones() -> None:
    outbox = Outbox(OutboxLimits(quantum=1000))
    for index in range(3):
        outbox.put_data("image", message(f"image{index}", 10_000))
    outbox.put_data("cancelGoal", message("cancel"))
    outbox.put_data("pose", message("pose"))
    assert drain(outbox)[:2] == ["cancel", "pose"]


def test_small_messages_pass_large_ones_that_have_credit() -> None:
    """As a velocity does, also if the images of two cameras have waited for long."""
    outbox = Outbox(OutboxLimits(quantum=1000))
    for camera in ("left", "right"):
        for number in range(2):
            outbox.put_data(camera, message(f"{camera}{number}", 20_000))
    first = outbox.pop()
    assert first is not None
    outbox.put_data("velocity", message("drive"))
    assert [text_of(first), drain(outbox)[0]] == ["left0", "drive"]


def test_only_the_newest_velocity_waits_and_goes_first() -> None:
    """Also where a statement about latched sources was the first message of its interface."""
    outbox = Outbox()
    outbox.put_latched("velocity", "", message("sources"), shared=False)
    outbox.put_data("map", message("map", 10_000_000))
    for number in range(3):
        outbox.put_data("velocity", message(f"velocity{number}"), queue_size=1)
    assert drain(outbox) == ["sources", "velocity2", "map"]
    assert outbox.dropped == {"velocity": 2}


def test_small_messages_starve_no_large_one() -> None:
    """A larger one has its turn after each quantum of small ones."""
    outbox = Outbox(OutboxLimits(quantum=1000))
    outbox.put_data("image", message("image", 10_000))
    texts = []
    for number in range(40):
        outbox.put_data("pose", message(f"pose{number}", 100))
        item = outbox.pop()
        assert item is not None
        texts.append(text_of(item))
    assert texts.count("image") == 1


def test_messages_of_one_interface_keep_their_order() -> None:
    """Its small messages do not pass its larger ones."""
    outbox = Outbox()
    for number, size in enumerate((10, 10_000, 10, 10_000)):
        outbox.put_data("scan", message(str(number), size))
    assert drain(outbox) == list("0123")


def test_discard_forgets_an_interface() -> None:
    outbox = Outbox()
    outbox.put_data("gone", message("x"))
    outbox.put_data("stays", message("y"))
    outbox.put_state("gone", message("z"))
    outbox.discard("gone")
    outbox.discard("never there")
    assert drain(outbox) == ["z", "y"]
    assert outbox.bytes == 0


@pytest.mark.parametrize("overflow", list(OverflowPolicy))
@given(
    operations=st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 300), st.booleans()), max_size=60)
)
def test_nothing_is_lost_uncounted_and_memory_is_bounded(
    overflow: OverflowPolicy, operations: list[tuple[str, int, bool]]
) -> None:
    limits = OutboxLimits(queue_messages=4, queue_bytes=500, total_bytes=900, quantum=64)
    outbox = Outbox(limits)
    put: dict[str, list[int]] = {"a": [], "b": [], "c": []}
    got: dict[str, list[int]] = {"a": [], "b": [], "c": []}
    refused = 0

    def take() -> None:
        item = outbox.pop()
        if item is not None:
            tag, _, number = text_of(item).partition(":")
            got[tag].append(int(number))

    for number, (tag, size, pop) in enumerate(operations):
        if outbox.put_data(tag, message(f"{tag}:{number}", size), overflow):
            put[tag].append(number)
        else:
            refused += 1
        assert outbox.bytes <= 3 * (500 + 310)
        if pop:
            take()
    while outbox:
        take()
    for tag in "abc":
        assert got[tag] == sorted(got[tag])
        assert len(put[tag]) == len(got[tag]) + outbox.dropped[tag]
    assert outbox.bytes == 0
    assert refused == 0 or overflow is OverflowPolicy.REFUSE


def test_latched_messages_are_neither_dropped_nor_in_the_way() -> None:
    """More than all queues hold comes at once: all of it waits, and ordinary messages have their room."""
    outbox = Outbox(OutboxLimits(queue_bytes=100, total_bytes=200))
    for number in range(10):
        outbox.put_latched(f"map{number}", "1", Outgoing(b"m" * 90), shared=False)
        outbox.put_data(f"map{number}", Outgoing(b"d" * 20))
    assert outbox.bytes == 10 * 90 + 10 * 20
    outbox.put_data("other", Outgoing(b"o" * 50))
    sent = [text[:1] for text in drain(outbox)]
    assert sent.count("m") == 10
    assert sent.count("o") == 1
    assert outbox.bytes == 0


def test_a_latched_message_takes_the_place_of_the_one_before() -> None:
    outbox = Outbox()
    outbox.put_latched("map", "1", Outgoing(b"old"), shared=False)
    outbox.put_data("map", Outgoing(b"between"))
    outbox.put_latched("map", "1", Outgoing(b"newer"), shared=False)
    assert drain(outbox) == ["between", "newer"]
    assert outbox.bytes == 0
    assert outbox.dropped["map"] == 1


def test_latched_message_kept_elsewhere_counts_once() -> None:
    """A latched message that is kept elsewhere is not counted twice."""
    outbox = Outbox()
    outbox.put_latched("map", "1", Outgoing(b"m" * 90), shared=True)
    assert outbox.bytes == 0
    outbox.drop_latched("map", "1")
    assert not outbox


def test_latched_messages_go_last_when_memory_is_short() -> None:
    outbox = Outbox()
    outbox.put_latched("map", "1", Outgoing(b"m" * 90), shared=False)
    outbox.put_data("map", Outgoing(b"d" * 20))
    outbox.shed(10)
    assert outbox.bytes == 90
    outbox.shed(10)
    assert outbox.bytes == 0
    assert not outbox


def test_a_statement_about_sources_outlives_short_memory() -> None:
    """It may take messages back that the robot got before."""
    outbox = Outbox()
    outbox.put_latched("map", "", Outgoing(b"sources"), shared=False)
    outbox.put_latched("map", "1", Outgoing(b"m" * 90), shared=False)
    outbox.shed(1000)
    assert drain(outbox) == ["sources"]
    assert outbox.bytes == 0
    assert outbox.dropped["map"] == 1


def test_each_source_has_a_latched_message_and_names_it() -> None:
    """One that ends before its message was sent takes back its own only."""
    outbox = Outbox()
    for source, text in (("1", b"old"), ("2", b"of 2"), ("3", b"of 3"), ("1", b"of 1")):
        message = Outgoing(b'{"type":"DM","data":{"iTag":"map","msg":"' + text + b'"}}')
        outbox.put_latched("map", source, LatchedDelivery(message, source), shared=False)
    outbox.drop_latched("map", "3")
    sent = [json.loads(text)["data"] for text in drain(outbox)]
    assert [(data["latch"], data["msg"]) for data in sent] == [("2", "of 2"), ("1", "of 1")]
    assert outbox.bytes == 0
    assert outbox.dropped["map"] == 2
