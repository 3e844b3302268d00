from __future__ import annotations

import json
import resource
import stat
from typing import TYPE_CHECKING

import pytest

from rce_master.audit import (
    BURST,
    MAX_KINDS,
    MAX_TEXT,
    OTHER_ACTIONS,
    PER_SECOND,
    STATION,
    AuditLog,
    describe,
)
from rce_master.state import commands

if TYPE_CHECKING:
    from pathlib import Path


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_records_survive_restart_and_ids_grow(tmp_path: Path) -> None:
    first = AuditLog(tmp_path / "audit", Clock())
    first.add("anna", "log_in", address="127.0.0.1")
    first.close()
    with (tmp_path / "audit" / "audit.jsonl").open("ab") as file:
        file.write(b'{"id":2,"ti')  # the crash came in between
    second = AuditLog(tmp_path / "audit", Clock())
    second.add("bob", "log_in")
    assert [(r.id, r.user) for r in second.since(0, 10)] == [(1, "anna"), (2, "bob")]
    assert stat.S_IMODE((tmp_path / "audit" / "audit.jsonl").stat().st_mode) == 0o600
    second.close()
    third = AuditLog(tmp_path / "audit", Clock())
    assert [r.user for r in third.since(-1, 10)] == ["bob"], "the half line cost no other one"


def test_disk_that_gets_full_within_a_record_costs_no_later_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A limit of the file's size stands for the disk: both let a part of the record be written."""
    log = AuditLog(tmp_path, Clock())
    log.add("anna", "log_in")
    file = tmp_path / "audit.jsonl"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file.stat().st_size + 10, hard))
    try:
        log.add("bob", "log_in")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "No space left on device" in caplog.text
    assert log.fault == "the audit log cannot be written: No space left on device"
    log.add("carol", "log_in")
    assert log.fault == ""
    log.close()
    first, half, last = file.read_bytes().splitlines()
    assert len(half) == 10
    assert [json.loads(line)["user"] for line in (first, last)] == ["anna", "carol"]


def test_files_take_turns_and_their_number_is_bounded(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, Clock(), max_bytes=1000, files=3)
    for number in range(200):
        log.add("anna", "create_container", f"anna/c{number}")
    log.close()
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["audit.jsonl", "audit.jsonl.1", "audit.jsonl.2"]
    assert all(file.stat().st_size <= 1000 for file in files)
    assert AuditLog(tmp_path, Clock(), max_bytes=1000, files=3).since(-1, 1)[0].subject == "anna/c199"


def test_flood_of_refusals_is_one_record_a_minute(tmp_path: Path) -> None:
    clock = Clock()
    log = AuditLog(tmp_path, clock)
    for _ in range(5000):
        log.refuse("anna", "log_in", address="10.0.0.1")
    assert [r.times for r in log.since(0, 10)] == [1]
    clock.now += 61
    log.flush()
    assert [r.times for r in log.since(0, 10)] == [1, 4999]
    log.close()


def test_clock_set_back_hides_no_refusals(tmp_path: Path) -> None:
    clock = Clock()
    clock.now = 100_000.0
    log = AuditLog(tmp_path, clock)
    for _ in range(3):
        log.refuse("anna", "log_in", address="10.0.0.1")
        log.refuse("bert", "log_in", address="10.0.0.1")
    clock.now -= 86_400
    log.refuse("anna", "log_in", address="10.0.0.1")
    log.flush()
    assert [(r.user, r.times) for r in log.since(2, 10)] == [("anna", 3), ("bert", 2)]
    log.close()


def test_refusals_from_many_addresses_stay_bounded(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, Clock())
    for number in range(3000):
        log.refuse("anna", "log_in", address=f"10.0.{number // 256}.{number % 256}")
    assert len(log._repeated) <= 1000
    log.close()


def test_flood_of_changes_leaves_the_records_of_others(tmp_path: Path) -> None:
    """A user who does the same thing over and over cannot push others' records out of the files."""
    clock = Clock()
    log = AuditLog(tmp_path, clock, max_bytes=1 << 20, files=2)
    log.add("bob", "create_container", "bob/c", address="10.0.0.2")
    for number in range(20_000):
        log.add("anna", "create_container", f"anna/c{number}", address="10.0.0.1")
        clock.now += 0.01
    clock.now += 61
    log.flush()
    found = log.since(0, 30_000)
    assert found[0].user == "bob"
    assert sum(record.times for record in found) == 20_001
    assert len(found) < BURST + 200 * PER_SECOND + 10
    assert found[-1].detail == "too often to be listed"
    log.add("anna", "remove_container", "anna/c1", address="10.0.0.1")
    assert log.since(-1, 1)[0].subject == "anna/c1"
    log.close()


@pytest.mark.parametrize("outcome", ["done", "refused"])
def test_flood_of_different_records_leaves_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outcome: str
) -> None:
    """A caller of ``POST /audit`` chooses outcome, action and address."""
    monkeypatch.setattr("rce_master.audit.KEPT", BURST + 100)
    log = AuditLog(tmp_path, Clock())
    log.add("bob", "create_container", "bob/c")
    count = BURST + 1000
    for number in range(count):
        action = "steer_" + "abcdefghij"[number % 10] * (number // 10 % 64)
        log.add("anna", action, address=f"10.0.{number // 256}.{number % 256}", outcome=outcome)
    log.close()
    found = log.since(0, 2 * count)
    assert found[0].user == "bob"
    assert sum(record.times for record in found) == count + 1
    assert found[-1].action == OTHER_ACTIONS
    assert len(found) <= BURST + 2 * MAX_KINDS + 3


@pytest.mark.slow
def test_refusals_from_too_many_addresses_are_counted(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, Clock())
    log.add("bob", "log_in")
    for number in range(BURST + 5000):
        log.refuse("anna", "log_in", address=f"10.1.{number // 256}.{number % 256}")
    log.add("anna", "log_in")
    assert log.since(-1, 1)[0].outcome == "done", "refusals that others cause hide no record of the user"
    log.close()
    found = log.since(0, 10_000)
    assert sum(record.times for record in found) == BURST + 5002
    assert len(found) <= BURST + 2 * MAX_KINDS + 5


def test_what_is_told_is_marked_and_hides_nothing(tmp_path: Path) -> None:
    """A user who tells too much is counted apart; also what is combined is marked as told."""
    clock = Clock()
    log = AuditLog(tmp_path, clock)
    for _ in range(BURST + 5):
        log.add("anna", "add_user", "root", via=STATION, client="192.0.2.7")
    log.add("anna", "create_container", "anna/c")
    clock.now += 120.0
    log.flush()
    found = log.since(0, 10_000)
    assert {record.via for record in found if record.action == "add_user"} == {STATION}
    assert sum(record.times for record in found if record.action == "add_user") == BURST + 5
    assert {record.client for record in found[:BURST]} == {"192.0.2.7"}
    (real,) = [record for record in found if record.action == "create_container"]
    assert (real.subject, real.via) == ("anna/c", "")
    log.close()


def test_records_by_user(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, Clock())
    for name in ("anna", "bob", "anna"):
        log.add(name, "log_in")
    assert [r.id for r in log.since(-10, 10, "anna")] == [1, 3]
    assert [r.id for r in log.since(1, 10, "anna")] == [3]
    log.close()


def test_text_is_bounded_one_line_and_without_tokens(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, Clock())
    token = "rce_" + "x" * 43
    log.add("anna", "revoke_token", f"anna/{token}", detail="\x1b[2J\n" + "y" * 5000, address="\x1b[2J")
    (record,) = log.since(0, 1)
    assert token not in record.subject
    assert len(record.detail) <= MAX_TEXT
    assert not {"\n", "\x1b"} & set(record.detail + record.address)
    log.close()
    assert token not in (tmp_path / "audit.jsonl").read_text()


def test_folder_that_cannot_be_written_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    log = AuditLog(tmp_path / "file" / "audit", Clock())
    log.add("anna", "log_in")
    assert len(log.since(0, 10)) == 1


def test_requests_are_named_without_values() -> None:
    wanted: list[commands.Command] = [
        commands.CreateContainer(user="anna", tag="c1"),
        commands.SetParameter(user="anna", container="c1", name="key", value="a secret value"),
        *(commands.DestroyContainer(user="anna", tag=f"d{n}") for n in range(10)),
    ]
    text = describe(wanted)
    assert text.startswith("create container c1, set parameter c1 key, destroy container d0")
    assert text.endswith("and 7 more")
    assert "secret" not in text
