"""What the sandbox of the namespace runtime leaves to nodes, as root and as a normal user."""

from __future__ import annotations

import errno
from typing import Any

import pytest
from support.persons import Person

from rce_container.environment.process import OF_NODES
from rce_container.forkserver.mounts import HOME
from rce_container.uids import FIRST_UID, UIDS

HOME_BYTES = 4 << 20
NO_CAPABILITIES = "0" * 16
REFUSED = (errno.EPERM, errno.ENOSYS, errno.EACCES)

pytestmark = [pytest.mark.needs("bwrap")]


@pytest.fixture(
    scope="session", params=["root", "normal", pytest.param("podman", marks=pytest.mark.needs("podman"))]
)
def person(request: pytest.FixtureRequest) -> Person:
    found = request.getfixturevalue(f"{request.param}_person")
    assert isinstance(found, Person)
    return found


@pytest.fixture(scope="session")
def found(person: Person) -> dict[str, Any]:
    return person.run("look", str(HOME_BYTES))


@pytest.fixture(params=["forked", "executed"])
def node(request: pytest.FixtureRequest, found: dict[str, Any]) -> dict[str, Any]:
    """What a node said that the node fork server forked, and one that was executed."""
    said = found[request.param]
    assert said["forked"] is (request.param == "forked")
    assert isinstance(said, dict)
    return said


def test_the_machine_has_all_that_is_needed(found: dict[str, Any]) -> None:
    assert found["detail"] == ""


def test_it_is_nobody(node: dict[str, Any], person: Person) -> None:
    assert node["uid"] == node["gid"] == [1000] * 3
    inside, outside, count = map(int, node["uid_map"])
    assert (inside, count) == (1000, 1)
    if person.name == "root":
        assert FIRST_UID <= node["outside"]["uid"] < FIRST_UID + UIDS
        assert outside == node["outside"]["uid"] == node["outside"]["logs"]
        assert node["groups"] == []
    else:
        assert node["outside"]["uid"] == person.uid


def test_it_has_no_rights(node: dict[str, Any]) -> None:
    for status in (node["status"], node["outside"]["status"]):
        for which in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"):
            assert status[which].strip() == NO_CAPABILITIES, which
        assert status["NoNewPrivs"].strip() == "1"
        assert status["Seccomp"].strip() == "2"
    assert node["core"] == 1
    assert node["outside"]["oom"] == [OF_NODES]


def test_every_namespace_is_its_own(node: dict[str, Any]) -> None:
    outside = node["outside"]["namespaces"]
    assert [kind for kind in outside if node["namespaces"][kind] == outside[kind]] == []


def test_calls_that_lead_out_are_refused(node: dict[str, Any]) -> None:
    calls = node["calls"]
    assert calls.pop("names") == 0, "the names of network interfaces can be listed"
    assert calls.pop("kill holder") in (0, errno.EPERM), "it does not die of it, or nobody had said this"
    assert calls.pop("setuid") == errno.EINVAL, "there is one user only"
    assert {name: code for name, code in calls.items() if code not in REFUSED} == {}


def test_the_environment_cannot_be_looked_into(node: dict[str, Any]) -> None:
    assert {name: code for name, code in node["environment"].items() if code not in REFUSED} == {}


def test_descriptors_are_the_standard_streams(node: dict[str, Any]) -> None:
    assert sorted(node["fds"]) == ["0", "1", "2"]
    assert node["fds"]["0"] == "/dev/null"
    assert all(node["fds"][fd].startswith("pipe:") for fd in "12")


def test_nothing_of_the_machines_variables_comes_in(node: dict[str, Any]) -> None:
    for env in (node["env"], node["shown"]):
        assert "RCE_SECRET" not in env
        assert "XDG_RUNTIME_DIR" not in env
        assert env["HOME"] == HOME
    assert node["env"]["RCE_NODE"] == node["shown"]["RCE_NODE"]
    assert any(word.endswith(("forked.py", "executed")) for word in node["cmdline"])


def test_no_path_leads_to_the_machines_disk(node: dict[str, Any]) -> None:
    assert node["exists"] == []
    writable = {mount[0].split()[4]: mount[1] for mount in node["mounts"] if _is_writable(mount)}
    memory = {path for path, source in writable.items() if source.split()[0] == "tmpfs"}
    assert memory == {HOME, "/tmp", "/dev/shm"}
    assert {path for path in writable if path not in memory and not path.startswith("/dev/")} == {"/proc"}


def _is_writable(mount: list[str]) -> bool:
    options = mount[0].split()[5].split(",")
    return "rw" in options


def test_what_is_not_its_own_cannot_be_written(node: dict[str, Any]) -> None:
    assert node["writable"] == []
    denied = (*REFUSED, errno.EROFS)
    assert {path: code for path, code in node["written"].items() if code not in denied} == {}
    assert node["hidden"] == {}


def test_home_and_tmp_are_limited(node: dict[str, Any]) -> None:
    assert node["size"][HOME] == HOME_BYTES
    assert node["home"] == 0o700
    assert node["cwd"] == HOME
    written, code = node["full"]
    assert written <= HOME_BYTES
    assert code == errno.ENOSPC
    assert node["many"] == errno.ENOSPC, "a folder may not be filled with empty files either"


def test_containers_have_users_of_their_own(person: Person) -> None:
    found = person.run("two")
    before, after = found["before"], found["after"]
    assert after["user/one"] == before["user/one"], "what was adopted is the same"
    if person.name == "root":
        assert len(set(after.values())) == 3
    else:
        assert set(after.values()) == {person.uid}
