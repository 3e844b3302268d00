"""Nodes that look around for what is not theirs: what they can see of the machine and of others."""

from __future__ import annotations

from typing import Any

import pytest
from support.persons import Person

pytestmark = [pytest.mark.needs("bwrap")]

SECRETS = {"secret", "other token", "neighbour", "treasure"}
NOTHING = {"nothing", "ENOENT", "EACCES"}

EXPECTED = {
    **{
        f"file {name}": {"ENOENT", "EACCES"}
        for name in (
            *("shadow", "root's home", "configuration", "state", "logs", "neighbour's folder", "users"),
            *("neighbour's process", "treasure", "shared treasure", "machine's packages"),
        )
    },
    **{
        f"/proc/{name}": NOTHING
        for name in (
            *("acpi", "cmdline", "config.gz", "diskstats", "driver", "interrupts", "kallsyms", "kcore"),
            *("key-users", "keys", "kmsg", "kpagecount", "mdstat", "modules", "partitions", "sched_debug"),
            *("schedstat", "softirqs", "swaps", "timer_list", "vmallocinfo"),
        )
    },
    "kernel log": {"EPERM"},
    "kernel pointers": {"none"},
    "processes": {"python rce-environment rce-node-server sh"},
    "interfaces": {"lo"},
    "addresses": {"127.0.0.1"},
    "routes": {"0"},
    "unix sockets": {"none"},
    "ipc": {"0"},
    "locks": {"0"},
    "machine's variables": {"none"},
    "machine's words": {"none"},
    "own memory": {"none"},
    "own memory with something in it": {"treasure"},
    "host name": {"box"},
    "sysfs": {"ENOENT"},
}


@pytest.mark.parametrize("look", EXPECTED)
def test_there_is_nothing_to_be_seen(attacked: dict[str, Any], look: str) -> None:
    assert attacked["spy"][look] in EXPECTED[look]


def test_there_was_something_to_be_seen(attacked: dict[str, Any], person: Person) -> None:
    assert {"shadow", "state", "logs", "neighbour's folder", "neighbour's process"} <= set(attacked["there"])
    assert ("users" in attacked["there"]) or person.uid != 0


def test_it_sees_its_own_branch_of_the_cgroups_only(attacked: dict[str, Any]) -> None:
    assert {line.rpartition(":")[2] for line in attacked["spy"]["cgroup"].splitlines()} == {"/"}


def test_mounts_name_folders_of_the_machine_but_nobody_else(attacked: dict[str, Any]) -> None:
    sources = attacked["spy"]["mount sources"]
    assert "/state/containers/" in sources, "the kernel tells from where something is mounted"
    assert [word for word in attacked["neighbour's words"] if word in sources] == []


def test_only_the_environment_knows_the_tokens_of_its_links(attacked: dict[str, Any], person: Person) -> None:
    """All processes that are forked by one fork server share its memory: it must not know anything."""
    memory = attacked["memory"]
    assert memory["fork server"] == []
    if person.uid == 0:
        assert memory["node fork server"] == []
        assert memory["environment"] == ["token"]


def test_nothing_that_was_looked_at_is_unknown(attacked: dict[str, Any]) -> None:
    assert set(attacked["spy"]) == {*EXPECTED, "cgroup", "mount sources"}
