"""Users for containers: each is given out once at a time, in whatever process its lock lives on."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rce_container.exceptions import StartError
from rce_container.uids import UidPool


def test_every_user_is_given_out_once(tmp_path: Path) -> None:
    pool = UidPool(5000, 3, tmp_path / "locks")
    taken = dict(pool.take() for _ in range(3))
    assert sorted(taken) == [5000, 5001, 5002]
    with pytest.raises(StartError, match="all 3 users from 5000 on"):
        pool.take()
    os.close(taken.pop(5001))
    uid, lock = pool.take()
    assert uid == 5001
    for fd in (lock, *taken.values()):
        os.close(fd)


def test_another_manager_does_not_give_out_the_same(tmp_path: Path) -> None:
    first, lock = UidPool(5000, 2, tmp_path).take()
    second, other = UidPool(5000, 2, tmp_path).take()
    assert {first, second} == {5000, 5001}
    os.close(lock)
    os.close(other)


def test_a_freed_user_is_given_out_last(tmp_path: Path) -> None:
    pool = UidPool(5000, 3, tmp_path)
    for expected in (5000, 5001, 5002, 5000):
        uid, lock = pool.take()
        os.close(lock)
        assert uid == expected


def test_shells_leave_the_lock_alone(tmp_path: Path) -> None:
    _, lock = UidPool(5000, 1, tmp_path).take()
    assert lock >= 10
    os.close(lock)


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StartError, match="cannot give out users by locks in"):
        UidPool(5000, 1, tmp_path / "file" / "locks").take()


def test_users_that_are_somebodys_are_told(tmp_path: Path) -> None:
    file = tmp_path / "subuid"
    file.write_text("one:100000:65536\ntwo:4990:11\nthree:5003:5\nnot a line\nfour:x:1\n")
    assert UidPool(5000, 3, tmp_path).owners(file) == ["two"]
    assert UidPool(0, 1, tmp_path).owners(file) == ["root"]
    assert UidPool(4_000_000, 10, tmp_path).owners(tmp_path / "none") == []
