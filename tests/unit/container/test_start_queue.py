"""Which container is started next."""

from __future__ import annotations

from rce_container.start_queue import StartQueue


class Starts:
    """Starts containers of a queue, one at a time or more."""

    def __init__(self, *ids: str) -> None:
        self.queue = StartQueue()
        self.starting: list[str] = []
        self.put(*ids)

    def put(self, *ids: str) -> None:
        for id_ in ids:
            self.queue.put(id_)

    def start(self) -> str | None:
        id_ = self.queue.take(self.starting)
        if id_ is not None:
            self.starting.append(id_)
        return id_

    def all(self) -> list[str]:
        """Start all, each when the one before is up."""
        order = []
        while (id_ := self.start()) is not None:
            order.append(id_)
            self.starting.remove(id_)
        return order


def test_a_user_with_many_does_not_keep_another_one_waiting() -> None:
    starts = Starts("a/c1")
    assert starts.start() == "a/c1"
    starts.put("a/c2", "a/c3", "a/c4", "a/c5", "b/c1")
    starts.starting.clear()
    assert starts.all() == ["b/c1", "a/c2", "a/c3", "a/c4", "a/c5"]


def test_users_take_turns() -> None:
    starts = Starts("a/c1", "a/c2", "a/c3", "b/c1", "b/c2", "c/c1")
    assert starts.all() == ["a/c1", "b/c1", "c/c1", "a/c2", "b/c2", "a/c3"]


def test_the_user_with_the_fewest_that_are_starting_is_next() -> None:
    """Slow starts of one user do not take all places."""
    starts = Starts("a/c1", "a/c2", "a/c3", "a/c4", "b/c1", "b/c2", "b/c3")
    assert [starts.start() for _ in range(4)] == ["a/c1", "b/c1", "a/c2", "b/c2"]
    starts.starting.remove("b/c1")
    assert starts.start() == "b/c3"


def test_one_user_may_have_all_places() -> None:
    starts = Starts("a/c1", "a/c2", "a/c3")
    assert [starts.start() for _ in range(4)] == ["a/c1", "a/c2", "a/c3", None]


def test_unwanted_containers_leave_the_queue() -> None:
    starts = Starts("a/c1", "b/c1", "a/c2", "b/c2")
    assert starts.queue.discard(lambda id_: id_ in ("a/c1", "b/c1", "b/c2")) == ["a/c1", "b/c1", "b/c2"]
    assert starts.queue.discard(lambda id_: False) == []
    assert starts.all() == ["a/c2"]


def test_users_that_have_left_are_forgotten() -> None:
    starts = Starts(*(f"user{number}/box" for number in range(100)))
    starts.all()
    assert starts.start() is None
    assert not starts.queue._turns
    assert not starts.queue._waiting
