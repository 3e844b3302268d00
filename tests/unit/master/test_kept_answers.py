"""Answers to requests with an Idempotency-Key: what is kept, for how long, and what it tells."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.master_world import World

from rce_master.answers import Answer, Answers, KeyedRequest, PendingAnswer
from rce_master.exceptions import ConflictError, InvalidRequestError, RefusedError, UnderWayError
from rce_master.http.idempotency import MAX_KEY, read_key
from rce_master.state import commands
from rce_master.state.answers import KEPT_S, MAX_ANSWERS
from rce_master.state.core import State
from rce_master.state.user_records import KeptAnswer, User, UserRole

SECRET = b"s" * 32
REQUEST = KeyedRequest("anna", "key-1", b'POST /api/v1/users\n{"password": "hunter2"}')
BODY = b'{"token": "rce_secret"}'


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def answers(world: World, clock: Clock) -> Answers:
    return Answers(world.state.tables, SECRET, clock)


def add_user(name: str) -> commands.AddUser:
    return commands.AddUser(user=User(name=name, role=UserRole.USER, password="x", created=0.0))


def do(
    world: World, answers: Answers, name: str, request: KeyedRequest = REQUEST, body: bytes = BODY
) -> None:
    world.do(PendingAnswer(answers, request, 201).with_answer(add_user(name), body))


def kept(answers: Answers, request: KeyedRequest = REQUEST) -> Answer | None:
    with answers.under_way(request) as former:
        return former


def test_repeat_gets_the_kept_answer(world: World, answers: Answers) -> None:
    assert kept(answers) is None
    do(world, answers, "bert")
    assert kept(answers) == Answer(201, BODY)
    assert kept(answers, replace(REQUEST, key="key-2")) is None
    assert kept(answers, replace(REQUEST, user="bert")) is None


def test_answer_without_body_is_kept(world: World, answers: Answers) -> None:
    do(world, answers, "bert", body=b"")
    assert kept(answers) == Answer(201, b"")


def test_other_request_with_the_key_is_refused(world: World, answers: Answers) -> None:
    do(world, answers, "bert")
    with pytest.raises(InvalidRequestError, match="another request"):
        kept(answers, replace(REQUEST, content=b"POST /api/v1/users\n{}"))


def test_second_request_waits_for_the_first(answers: Answers) -> None:
    with answers.under_way(REQUEST):
        with pytest.raises(UnderWayError, match="under way"):
            kept(answers)
        assert kept(answers, replace(REQUEST, user="bert")) is None
    assert kept(answers) is None


def test_refused_command_keeps_no_answer(world: World, answers: Answers) -> None:
    with pytest.raises(ConflictError, match="already"):
        do(world, answers, "anna")
    assert kept(answers) is None


def test_answer_and_effect_are_one_transaction(world: World, answers: Answers) -> None:
    """What was done once is not done again, also if both passed the look at the kept answers."""
    do(world, answers, "bert")
    with pytest.raises(ConflictError, match="done meanwhile"):
        do(world, answers, "carl")
    assert "carl" not in world.state.tables.users
    changes = world.do(
        PendingAnswer(answers, replace(REQUEST, key="b"), 204).with_answer(add_user("dora"), b"")
    )
    assert {row.table for row in changes.rows()} == {"users", "answers"}
    changes.revert()
    assert "dora" not in world.state.tables.users
    assert kept(answers, replace(REQUEST, key="b")) is None


def test_store_holds_no_secret_of_request_or_answer(world: World, answers: Answers) -> None:
    do(world, answers, "bert")
    table = world.state.tables.answers
    (record,) = table
    stored = table.encode(record)
    for secret in (b"hunter2", b"rce_secret", b"key-1"):
        assert secret not in stored
        assert secret not in record.body


def test_answers_outlive_the_process(world: World, answers: Answers, clock: Clock) -> None:
    do(world, answers, "bert")
    tables = world.state.tables.all
    snapshot = {
        table.name: {table.key(r): table.encode(r) for r in table} for table in tables if table.persistent
    }
    state = State.load(snapshot, 0.0)
    state.validate()
    assert kept(Answers(state.tables, SECRET, clock)) == Answer(201, BODY)


def test_new_engine_secret_makes_answers_unreadable_not_undone(
    world: World, answers: Answers, clock: Clock
) -> None:
    do(world, answers, "bert")
    with pytest.raises(ConflictError, match="secret was changed"):
        kept(Answers(world.state.tables, b"t" * 32, clock))


def test_damaged_answer_is_refused(world: World, answers: Answers) -> None:
    do(world, answers, "bert")
    (record,) = world.state.tables.answers
    damaged = KeptAnswer(
        user=record.user,
        digest=record.digest,
        created=record.created,
        status=record.status,
        mark=record.mark,
        request=record.request,
        body=record.body[:-1] + bytes([record.body[-1] ^ 1]),
    )
    world.state.tables.answers.assign(record.id, damaged)
    with pytest.raises(ConflictError, match="damaged"):
        kept(answers)


def test_old_answers_are_forgotten(world: World, answers: Answers, clock: Clock) -> None:
    do(world, answers, "bert")
    clock.now += KEPT_S - 1
    world.do(commands.ForgetAnswers(now=clock.now))
    assert kept(answers) is not None
    clock.now += 1
    assert kept(answers) is None
    world.do(commands.ForgetAnswers(now=clock.now))
    assert not len(world.state.tables.answers)


def test_user_keeps_the_newest_answers(world: World, answers: Answers) -> None:
    world.user("bert")
    other = replace(REQUEST, user="bert")
    do(world, answers, "other", other)
    for number in range(MAX_ANSWERS + 2):
        user = User(name=f"u{number}", role=UserRole.USER, password="x", created=0.0)
        request = replace(REQUEST, key=str(number))
        command = PendingAnswer(answers, request, 204).with_answer(commands.AddUser(user=user), b"")
        world.state.apply(command, 0.0)
    world.state.validate()
    assert world.state.tables.answers.count("user", "anna") == MAX_ANSWERS
    assert kept(answers, replace(REQUEST, key="1")) is None
    assert kept(answers, replace(REQUEST, key="2")) is not None
    assert kept(answers, other) is not None


def test_removed_user_has_no_answers(world: World, answers: Answers) -> None:
    world.user("root", UserRole.ADMIN)
    do(world, answers, "bert")
    world.do(commands.RemoveUser(name="anna"))
    assert not len(world.state.tables.answers)
    do(world, answers, "carl")  # who asked was removed meanwhile
    assert not len(world.state.tables.answers)


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ([], ""),
        (["abc"], "abc"),
        (['"8e03978e-40d5"'], "8e03978e-40d5"),
        (['  "a b"  '], "a b"),
        ([r'"a\"b\\c"'], r"a\"b\c".replace('\\"', '"')),
        (["x" * MAX_KEY], "x" * MAX_KEY),
    ],
)
def test_keys_are_read_with_or_without_quotes(values: list[str], key: str) -> None:
    assert read_key(values) == key


@pytest.mark.parametrize("values", [[""], ['""'], ["x" * (MAX_KEY + 1)], ["a", "a"], ["\xe9"], ["a\tb"]])
def test_other_headers_are_refused(values: list[str]) -> None:
    with pytest.raises(RefusedError, match="Idempotency-Key: expected"):
        read_key(values)
