"""``rce user ... --state-dir``: the store without a master, and what the audit log has of it."""

from __future__ import annotations

import getpass
import json
from typing import TYPE_CHECKING, Any

from support.master_program import master, rce

from rce.config.master_settings import MasterSettings
from rce.config.settings import EngineSettings

if TYPE_CHECKING:
    from pathlib import Path


def records(folder: Path) -> list[dict[str, Any]]:
    file = folder / "state" / "master" / "audit" / "audit.jsonl"
    return [json.loads(line) for line in file.read_bytes().splitlines()]


async def test_changes_without_a_master_are_in_the_audit_log(tmp_path: Path) -> None:
    """Who is the user of the operating system. What is only shown is not noted, and no password is."""
    at = ("--state-dir", str(tmp_path / "state"))
    secret = "a secret password"
    await rce(tmp_path, "user", "add", "anna", "--password-stdin", *at, text=f"{secret}\n")
    told = await rce(tmp_path, "user", "limit", "anna", "--containers", "7", "--memory", "2G", *at)
    assert told.splitlines()[1].split()[:3] == ["containers", "0", "7"]
    shown = await rce(tmp_path, "user", "show", "anna", *at)
    assert shown.startswith("anna: user since ")
    assert shown.splitlines()[2:] == told.splitlines()[1:]
    refused = await rce(tmp_path, "user", "limit", "anna", "--containers", "many", *at, code=1)
    assert "containers: must be a whole number from 0 to" in refused
    found = records(tmp_path)
    assert [(one["action"], one["subject"]) for one in found] == [
        ("add_user", "anna/user"),
        ("set_limits", "anna"),
    ]
    assert {(one["user"], one["address"]) for one in found} == {(getpass.getuser(), "offline")}
    assert secret not in json.dumps(found)
    async with master(tmp_path, "--dev") as url:
        await rce(tmp_path, "login", "-u", "testUser", "--password-stdin", url, text="testUser\n")
        listed = await rce(tmp_path, "audit")
        assert "set_limits" in listed
        assert "offline" in listed
    assert [one["id"] for one in records(tmp_path)] == sorted(one["id"] for one in records(tmp_path))


async def test_a_new_state_is_found_by_both_programs(tmp_path: Path) -> None:
    """The first user is made before ``rce up`` or ``rce-master`` made the folder, with the same option."""
    at = ("--state-dir", str(tmp_path / "state"))
    await rce(tmp_path, "user", "add", "anna", "--password-stdin", *at, text="secret\n")
    engine = EngineSettings(state_dir=tmp_path / "state")
    alone = EngineSettings(master=MasterSettings(state_dir=tmp_path / "state"))
    assert engine.master_state == alone.master_state == tmp_path / "state" / "master"
    async with master(tmp_path) as url:
        await rce(tmp_path, "login", "-u", "anna", "--password-stdin", url, text="secret\n")
    assert not (tmp_path / "state" / "rce.sqlite").exists()


async def test_two_states_in_one_folder_are_refused(tmp_path: Path) -> None:
    state = tmp_path / "state"
    at = ("--state-dir", str(state))
    await rce(tmp_path, "user", "add", "anna", "--password-stdin", *at, text="secret\n")
    (state / "rce.sqlite").write_bytes((state / "master" / "rce.sqlite").read_bytes())
    refused = await rce(tmp_path, "user", "list", *at, code=1)
    assert "both hold a master's state" in " ".join(refused.split())
    named = await rce(tmp_path, "user", "list", "--state-dir", str(state / "master"))
    assert "anna" in named
