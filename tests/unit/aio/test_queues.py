"""Bounded queues."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rce.aio.queues import BoundedQueue, OverflowPolicy

MOST_ITEMS, MOST_BYTES = 4, 100
SIZES = st.integers(0, 150)
KEYS = st.sampled_from(["a", "b", "c"])


def take_all(queue: BoundedQueue[str]) -> list[str]:
    return [queue.take() for _ in range(len(queue))]


def test_items_leave_in_their_order() -> None:
    queue: BoundedQueue[str] = BoundedQueue(10, 10)
    for text in "abc":
        assert queue.put(text, 1)
    assert (queue.head, queue.peek(), queue.head_size, queue.kept_head) == ("a", "a", 1, None)
    assert list(queue) == ["a", "b", "c"]
    assert take_all(queue) == ["a", "b", "c"]
    assert (queue.bytes, queue.dropped) == (0, 0)


def test_the_oldest_are_dropped_and_told() -> None:
    gone: list[str] = []
    queue: BoundedQueue[str] = BoundedQueue(2, 100, on_drop=gone.append)
    for text in "abcd":
        queue.put(text, 1)
    assert (gone, queue.dropped, take_all(queue)) == (["a", "b"], 2, ["c", "d"])


def test_bytes_are_bounded_but_one_large_item_may_wait() -> None:
    queue: BoundedQueue[str] = BoundedQueue(10, 100)
    queue.put("large", 500)
    assert len(queue) == 1
    queue.put("a", 60)
    queue.put("b", 40)
    queue.put("c", 1)
    assert (take_all(queue), queue.dropped) == (["b", "c"], 2)


def test_a_queue_that_refuses_loses_nothing() -> None:
    queue: BoundedQueue[str] = BoundedQueue(2, 100, OverflowPolicy.REFUSE)
    assert [queue.put(text, 1) for text in "abc"] == [True, True, False]
    assert (take_all(queue), queue.dropped) == (["a", "b"], 0)
    assert queue.put("large", 500)
    assert not queue.put("d", 1)


def test_a_kept_item_goes_only_for_a_newer_one_of_its_key() -> None:
    queue: BoundedQueue[str] = BoundedQueue(2, 100)
    queue.put("old map", 10, "map")
    queue.put("1", 1)
    queue.put("2", 1)
    queue.put("3", 1)
    assert list(queue) == ["old map", "2", "3"]
    queue.put("new map", 10, "map")
    assert list(queue) == ["2", "3", "new map"], "the old map counts again, and is the oldest"
    queue.put("4", 1)
    assert list(queue) == ["3", "new map", "4"]
    assert (queue.bytes, queue.kept_bytes, queue.droppable_bytes) == (12, 10, 2)


def test_both_items_of_a_key_leave_where_there_is_room() -> None:
    queue: BoundedQueue[str] = BoundedQueue(5, 100)
    queue.put("old", 1, "map")
    queue.put("new", 1, "map")
    assert take_all(queue) == ["old", "new"]


def test_shedding_leaves_kept_items() -> None:
    queue: BoundedQueue[str] = BoundedQueue(5, 100)
    queue.put("map", 10, "map")
    queue.put("1", 10)
    queue.put("2", 10)
    queue.shed(11)
    assert list(queue) == ["map"]
    queue.shed(1)
    assert list(queue) == ["map"]
    queue.release("map")
    assert (queue.bytes, queue.kept_bytes) == (10, 0)
    queue.shed(1)
    assert (len(queue), queue.bytes, queue.dropped) == (0, 0, 3)


def test_what_is_removed_is_not_counted_as_dropped() -> None:
    queue: BoundedQueue[str] = BoundedQueue(5, 100)
    queue.put("map", 10, "map")
    queue.put("1", 1)
    assert queue.remove_kept("map")
    assert not queue.remove_kept("map")
    assert queue.remove(lambda item: item == "1")
    assert not queue.remove(lambda item: item == "1")
    queue.put("2", 1)
    queue.clear()
    assert (len(queue), queue.bytes, queue.dropped) == (0, 0, 0)


def test_a_queue_without_room_is_refused() -> None:
    with pytest.raises(ValueError, match="a queue holds at least one item, not 0"):
        BoundedQueue(0, 1)


def test_an_empty_queue_has_no_head() -> None:
    queue: BoundedQueue[str] = BoundedQueue(1, 1)
    with pytest.raises(IndexError):
        queue.take()
    with pytest.raises(IndexError):
        _ = queue.head
    assert queue.peek() is None
    assert not queue.drop_oldest()


class QueueModel(RuleBasedStateMachine):
    """The queue does what a plain list and its definition do."""

    def __init__(self) -> None:
        super().__init__()
        self.gone: list[int] = []
        self.queue: BoundedQueue[int] = BoundedQueue(MOST_ITEMS, MOST_BYTES, on_drop=self.gone.append)
        self.model: list[tuple[int, int, str | None]] = []
        self.number = 0
        self.lost: list[int] = []

    def kept(self) -> list[tuple[int, int, str | None]]:
        newest = {key: number for number, _, key in self.model if key is not None}
        return [entry for entry in self.model if entry[2] is not None and newest[entry[2]] == entry[0]]

    def droppable(self) -> list[tuple[int, int, str | None]]:
        kept = self.kept()
        return [entry for entry in self.model if entry not in kept]

    def drop(self) -> None:
        entry = self.droppable()[0]
        self.model.remove(entry)
        self.lost.append(entry[0])

    @rule(size=SIZES)
    def put(self, size: int) -> None:
        while (some := self.droppable()) and (
            len(some) >= MOST_ITEMS or sum(entry[1] for entry in some) + size > MOST_BYTES
        ):
            self.drop()
        self.number += 1
        self.model.append((self.number, size, None))
        assert self.queue.put(self.number, size)

    @rule(size=SIZES, key=KEYS)
    def put_kept(self, size: int, key: str) -> None:
        self.number += 1
        self.model.append((self.number, size, key))
        while len(some := self.droppable()) > 1 and (
            len(some) > MOST_ITEMS or sum(entry[1] for entry in some) > MOST_BYTES
        ):
            self.drop()
        assert self.queue.put(self.number, size, key)

    @precondition(lambda self: self.model)
    @rule()
    def take(self) -> None:
        is_kept = self.model[0] in self.kept()
        assert self.queue.kept_head == (self.model[0][2] if is_kept else None)
        assert self.queue.head == self.model[0][0]
        assert self.queue.head_size == self.model[0][1]
        assert self.queue.take() == self.model.pop(0)[0]

    @rule()
    def drop_oldest(self) -> None:
        can = bool(self.droppable())
        if can:
            self.drop()
        assert self.queue.drop_oldest() == can

    @rule(key=KEYS)
    def remove_kept(self, key: str) -> None:
        found = [entry for entry in self.kept() if entry[2] == key]
        # An older one of the key that still waits stays, and may be dropped.
        assert self.queue.remove_kept(key) == bool(found)
        self.model = [
            (number, size, None if found and its_key == key else its_key)
            for number, size, its_key in self.model
            if (number, size, its_key) not in found
        ]

    @rule(number=st.integers(1, 20))
    def remove(self, number: int) -> None:
        found = [entry for entry in self.model if entry[0] == number]
        assert self.queue.remove(lambda item: item == number) == bool(found)
        if found and found[0] in self.kept():
            key = found[0][2]
            self.model = [(n, size, None if k == key else k) for n, size, k in self.model]
        self.model = [entry for entry in self.model if entry[0] != number]

    @rule(size=SIZES)
    def shed(self, size: int) -> None:
        goal = sum(entry[1] for entry in self.model) - size
        while self.droppable() and sum(entry[1] for entry in self.model) > goal:
            self.drop()
        self.queue.shed(size)

    @rule(key=KEYS)
    def release(self, key: str) -> None:
        self.model = [(*entry[:2], None) if entry[2] == key else entry for entry in self.model]
        self.queue.release(key)

    @rule()
    def clear(self) -> None:
        self.model.clear()
        self.queue.clear()

    @invariant()
    def is_like_the_model(self) -> None:
        assert list(self.queue) == [entry[0] for entry in self.model]
        assert len(self.queue) == len(self.model)
        assert self.queue.bytes == sum(entry[1] for entry in self.model)
        assert self.queue.kept_bytes == sum(entry[1] for entry in self.kept())
        assert self.queue.droppable == len(self.droppable())
        assert self.gone == self.lost
        assert self.queue.dropped == len(self.lost)


TestQueueModel = QueueModel.TestCase


@given(st.lists(st.one_of(SIZES, st.none()), max_size=60))
def test_a_refusing_queue_keeps_its_bounds(steps: list[int | None]) -> None:
    """A number puts so many bytes, None takes."""
    queue: BoundedQueue[int] = BoundedQueue(MOST_ITEMS, MOST_BYTES, OverflowPolicy.REFUSE)
    waiting: list[int] = []
    for size in steps:
        if size is None:
            if waiting:
                assert queue.take() == waiting.pop(0)
            continue
        fits = not waiting or (len(waiting) < MOST_ITEMS and sum(waiting) + size <= MOST_BYTES)
        assert queue.put(size, size) == fits
        waiting += [size] if fits else []
        assert list(queue) == waiting
    assert queue.dropped == 0
