"""The book of tasks: requests, states, keys, revisions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rce_fleet.exceptions import KeyReusedError, RevisionError, TaskRefusedError, UnknownTaskError
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.order import Action, Order, Stop
from rce_fleet.tasks.task import Task, TaskState

GO = Order((Stop(Action.GO, (5,)),))
DELIVERY = Order((Stop(Action.PICK, (3,), 2.0), Stop(Action.DELIVER, (12,), 2.0)))


@pytest.fixture
def book() -> TaskBook:
    made = TaskBook()
    made.grid = GridMap(blocked=frozenset({9}))
    return made


def test_the_same_key_gives_the_same_task(book: TaskBook) -> None:
    first = book.create(DELIVERY, 1.0, user="erp", key="order-1")
    again = book.create(DELIVERY, 2.0, user="erp", key="order-1")
    other = book.create(DELIVERY, 2.0, user="other", key="order-1")
    assert (first.id, again.id, other.id) == ("T1", "T1", "T2")
    assert len(book.take_events()) == 2


def test_a_key_with_another_content_is_refused(book: TaskBook) -> None:
    book.create(DELIVERY, 1.0, user="erp", key="order-1")
    with pytest.raises(KeyReusedError, match="T1, which has another content"):
        book.create(GO, 1.0, user="erp", key="order-1")


def test_a_changed_task_keeps_its_key(book: TaskBook) -> None:
    """The key is compared with what was first asked for, not with what the task is now."""
    task = book.create(DELIVERY, 1.0, user="erp", key="order-1")
    book.change(task.id, GO, 2.0)
    assert book.create(DELIVERY, 3.0, user="erp", key="order-1").id == task.id


@pytest.mark.parametrize(
    ("order", "reason"),
    [
        (Order(()), "at least one stop"),
        (Order((Stop(Action.GO),)), "stop 1 .go. needs a cell"),
        (Order((Stop(Action.DELIVER, (1,)),)), "no load to deliver"),
        (Order((Stop(Action.GO, (1,)),), rounds=501), "at most 500 stops"),
        (Order((Stop(Action.GO, (99,)),)), "cell 99 is not on the map of 64 cells"),
        (Order((Stop(Action.GO, (9,)),)), "cell 9 is a wall"),
        (Order((Stop(Action.GO, (1,)),), payload=-1.0), "payload"),
        (Order((Stop(Action.GO, (1,)),), deadline=5.0, earliest_start=6.0), "deadline must be after"),
        (Order((Stop(Action.GO, (1,)),), after=("T7",)), "cannot come after T7"),
        (Order((Stop(Action.GO, (1,), float("nan")),)), "duration"),
        (Order((Stop(Action.PICK, (1,)),), rounds=2), "deliver in each round"),
        (Order((Stop(Action.GO, (1,)),), occurrences=2), "every"),
        (Order((Stop(Action.GO, (1,)), Stop(Action.PICK, (2,)))), "stop 2 .pick. takes a load that no stop"),
    ],
)
def test_impossible_orders_are_refused(book: TaskBook, order: Order, reason: str) -> None:
    with pytest.raises(TaskRefusedError, match=reason):
        book.create(order, 0.0)
    assert not book.tasks
    assert book.take_events() == []


def test_a_task_after_a_long_chain_looks_at_the_one_before_it_only(
    book: TaskBook, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other task can wait for a new one: to look along the chain made 10 000 tasks take minutes."""
    last = book.create(GO, 0.0)
    for _ in range(200):
        last = book.create(replace(GO, after=(last.id,)), 0.0)
    asked: list[str] = []
    find = book.find

    def noted(task_id: str) -> Task:
        asked.append(task_id)
        return find(task_id)

    monkeypatch.setattr(book, "find", noted)
    book.create(replace(GO, after=(last.id,)), 0.0)
    assert asked == [last.id]
    with pytest.raises(TaskRefusedError, match="T1 would wait for itself"):
        book.change("T1", replace(GO, after=(last.id,)), 1.0)


def test_an_old_revision_changes_nothing(book: TaskBook) -> None:
    task = book.create(GO, 0.0)
    held = book.hold(task.id, 1.0, revision=1)
    assert held.revision == 2
    with pytest.raises(RevisionError, match="at revision 2, not 1"):
        book.cancel(task.id, 2.0, revision=1)
    assert book.find(task.id).state is TaskState.HELD


def test_hold_resume_and_cancel_can_be_repeated(book: TaskBook) -> None:
    task = book.create(GO, 0.0)
    for _ in range(2):
        assert book.hold(task.id, 1.0).state is TaskState.HELD
    for _ in range(2):
        assert book.resume(task.id, 2.0).state is TaskState.QUEUED
    for _ in range(2):
        assert book.cancel(task.id, 3.0, user="anna").state is TaskState.CANCELLED
    assert book.find(task.id).reason == "cancelled by anna"
    with pytest.raises(TaskRefusedError, match="cannot be held"):
        book.hold(task.id, 4.0)
    with pytest.raises(TaskRefusedError, match="cannot be resumed"):
        book.resume(task.id, 4.0)


def test_a_task_cannot_wait_for_itself(book: TaskBook) -> None:
    first = book.create(GO, 0.0)
    second = book.create(Order(GO.stops, after=(first.id,)), 0.0)
    with pytest.raises(TaskRefusedError, match="wait for itself"):
        book.change(first.id, Order(GO.stops, after=(second.id,)), 1.0)


@pytest.mark.parametrize("name", ["", "T", "T2", "1", "T01", "T-1", "T²", "T99999999999999999999"])
def test_unknown_tasks_are_reported(book: TaskBook, name: str) -> None:
    book.create(GO, 0.0)
    with pytest.raises(UnknownTaskError):
        book.find(name)


def test_events_make_the_same_book_again(book: TaskBook) -> None:
    task = book.create(DELIVERY, 1.0, user="erp", key="order-1")
    book.hold(task.id, 2.0)
    book.create(GO, 3.0)
    copy = TaskBook()
    for event in book.take_events():
        copy.put(event)
    assert (copy.tasks, copy.number) == (book.tasks, book.number)
    copy.grid = book.grid
    assert copy.create(DELIVERY, 4.0, user="erp", key="order-1").id == task.id
    assert copy.create(GO, 4.0).id == "T3"


def test_lists_of_tasks_follow_each_change(book: TaskBook) -> None:
    """By state, recurrence and cell, as all tasks tell."""

    def check() -> None:
        tasks = list(book.tasks.values())
        for state in TaskState:
            assert book.numbers([state.value]) == [task.number for task in tasks if task.state is state]
        open_tasks = [task for task in tasks if not task.has_ended]
        assert book.numbers(["open"]) == [task.number for task in open_tasks] == list(book.open_numbers())
        assert book.numbers(["ended", "held"]) == [
            task.number for task in tasks if task.has_ended or task.state is TaskState.HELD
        ]
        recurring = [task for task in tasks if task.recurs_at is not None]
        assert (sorted(book.recurring_tasks(), key=lambda task: task.number), book.numbers()) == (
            recurring,
            [task.number for task in tasks],
        )
        assert set(book.used_cells()) == {cell for task in open_tasks for cell in task.order.cells()}

    orders = [Order((Stop(Action.GO, (cell, 12)),), every=every) for cell, every in ((3, None), (4, 60.0))]
    for order in (*orders, *orders):
        book.create(order, 0.0)
        check()
    book.hold("T1", 1.0)
    check()
    book.change("T1", Order((Stop(Action.GO, (17,)), Stop(Action.GO, (17,)))), 2.0)
    check()
    assert 17 in book.used_cells()
    book.change("T1", orders[0], 2.0)
    assert 17 not in book.used_cells()
    for task in ("T1", "T2", "T3"):
        book.cancel(task, 3.0)
        check()
    for number in (1, 2):
        book.forget(number)
        check()
