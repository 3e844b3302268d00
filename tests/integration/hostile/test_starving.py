"""Nodes that take all they can get, of one thing after the other; a neighbour of another user works on."""

from __future__ import annotations

from typing import Any

import pytest
from support.hostile_world import MEMORY_MB, MODULE, OUTSIDE, PROCESSES
from support.persons import Person

pytestmark = [pytest.mark.needs("bwrap"), pytest.mark.xdist_group("starving")]

KILLED, NO_SPACE, NO_MORE = {"killed"}, {"ENOSPC"}, {"EAGAIN"}
NODE_OR_CONTAINER = KILLED | {"the container died"}
"""A killed node gives its memory back some time later, on a busy machine late: before that, the kernel may
kill the environment, if it asks for a page. What descriptors and page tables hold comes last."""
OWN_PROCESSES = 4
"""Holder, environment, node fork server, and the attacker itself."""

MEMORY = {
    "anonymous": NODE_OR_CONTAINER,
    "home": NO_SPACE,
    "tmp": NODE_OR_CONTAINER,
    "shm": NODE_OR_CONTAINER,
    "shared": NODE_OR_CONTAINER,
    "memfd": NODE_OR_CONTAINER,
    "pipes": NODE_OR_CONTAINER,
    "unix": NODE_OR_CONTAINER,
    "tables": NODE_OR_CONTAINER,
}
COUNTED = {"forks": NO_MORE, "vforks": NO_MORE, "zombies": NO_MORE, "threads": NO_MORE}
FLOODS = {"processors", "output", "rosout", "graph", "flapping"}
THINGS = (*MEMORY, "tcp", *COUNTED, "empty", "files", "passing", *sorted(FLOODS), "kill", "stop")
COUNTED_ANYWAY = ("forks", "threads")
WITHOUT_CGROUPS = (
    "anonymous",
    "home",
    *COUNTED_ANYWAY,
    "files",
    "passing",
    "processors",
    "graph",
    "kill",
    "stop",
)

DISK_MB = 5
"""What a container may leave on the machine's disk while it lives: two pieces of a megabyte for each log."""
REPORTS = 60


@pytest.fixture(scope="module")
def starved(root_person: Person) -> dict[str, Any]:
    return root_person.run("starve", *THINGS, module=MODULE)


@pytest.fixture(scope="module")
def weakly(normal_person: Person) -> dict[str, Any]:
    """The same where limits are weak: the user may make no cgroups."""
    return normal_person.run("starve", *WITHOUT_CGROUPS, module=MODULE)


@pytest.mark.needs("cgroups")
@pytest.mark.parametrize("thing", MEMORY)
def test_memory_ends_at_the_limit(starved: dict[str, Any], thing: str) -> None:
    assert starved[thing]["ended"] in MEMORY[thing], starved[thing]["faults"]
    assert starved[thing]["has"] <= MEMORY_MB


@pytest.mark.needs("cgroups")
def test_connections_hold_little_more_than_the_limit(starved: dict[str, Any]) -> None:
    assert starved["tcp"]["ended"] in ("killed", "had enough")
    assert starved["tcp"]["tcp"] <= 2 * MEMORY_MB
    assert starved["outside"]["tcp"] == "had enough"


@pytest.mark.needs("cgroups")
@pytest.mark.parametrize("thing", COUNTED)
def test_processes_end_at_the_limit(starved: dict[str, Any], thing: str) -> None:
    assert starved[thing]["ended"] in COUNTED[thing]
    assert 10 < starved[thing]["has"] <= PROCESSES - OWN_PROCESSES


@pytest.mark.needs("cgroups")
def test_files_are_counted(starved: dict[str, Any]) -> None:
    assert starved["empty"]["ended"] in ("ENOSPC", "killed")
    assert starved["files"]["ended"] in ("EMFILE", "killed")
    assert starved["passing"]["ended"] in ("ETOOMANYREFS", "killed")


@pytest.mark.needs("cgroups")
@pytest.mark.parametrize("thing", THINGS)
def test_others_go_on_and_the_disk_stays_free(starved: dict[str, Any], thing: str) -> None:
    found = starved[thing]
    assert found["answers"] == 3
    assert found["disk"] <= DISK_MB
    assert found["reports"] <= REPORTS


@pytest.mark.needs("cgroups")
def test_the_neighbour_lives(starved: dict[str, Any]) -> None:
    assert starved["neighbour lives"]


@pytest.mark.needs("cgroups")
def test_who_kills_all_that_can_be_killed_ends_the_own_container(starved: dict[str, Any]) -> None:
    assert starved["kill"]["ended"] == "the container died"


@pytest.mark.needs("cgroups")
def test_without_a_container_nothing_stops_them(starved: dict[str, Any]) -> None:
    assert starved["outside"] == dict.fromkeys((thing for thing in THINGS if thing in OUTSIDE), "had enough")


@pytest.mark.parametrize("thing", COUNTED_ANYWAY)
def test_without_cgroups_processes_are_counted_nevertheless(weakly: dict[str, Any], thing: str) -> None:
    assert weakly[thing]["ended"] in COUNTED[thing]
    assert 10 < weakly[thing]["has"] <= PROCESSES - OWN_PROCESSES


def test_without_cgroups_a_process_has_its_memory_limited(weakly: dict[str, Any]) -> None:
    assert weakly["anonymous"]["ended"] == "MemoryError"
    assert weakly["anonymous"]["has"] <= MEMORY_MB
    assert weakly["home"]["ended"] in NO_SPACE
    assert weakly["passing"]["ended"] == "ETOOMANYREFS"
    assert weakly["files"]["ended"] == "EMFILE"


@pytest.mark.parametrize("thing", WITHOUT_CGROUPS)
def test_without_cgroups_others_go_on(weakly: dict[str, Any], thing: str) -> None:
    assert weakly[thing]["answers"] == 3
    assert weakly[thing]["disk"] <= DISK_MB


def test_without_cgroups_the_neighbour_lives(weakly: dict[str, Any]) -> None:
    assert weakly["neighbour lives"]
    assert weakly["kill"]["ended"] == "the container died"
