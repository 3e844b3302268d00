"""What the sandbox of the namespace runtime leaves to nodes, as root and as a normal user."""

from __future__ import annotations

import errno
import json
import os
import pwd
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import pytest

from rce_container.environment.process import OF_NODES
from rce_container.runtimes.namespace import HOME
from rce_container.uids import FIRST_UID, UIDS

ROOT = Path(__file__).parents[3]
USER = "rce-test"
SYSTEM_PYTHON = "/usr/bin/python3"
HOME_BYTES = 4 << 20
NO_CAPABILITIES = "0" * 16
REFUSED = (errno.EPERM, errno.ENOSYS, errno.EACCES)

pytestmark = [pytest.mark.needs("bwrap"), pytest.mark.timeout(120)]


class Person:
    """Who runs the engine: how its programs are started, and where it may write."""

    runtime = "namespace"

    def __init__(self, name: str, prefix: Sequence[str], python: str, source: Path, folder: Path) -> None:
        self.name = name
        self.uid = pwd.getpwnam(name).pw_uid
        self.folder = folder
        self._prefix = prefix
        self._python = python
        self._source = source

    def run(self, *words: str) -> dict[str, Any]:
        """Run :mod:`support.sandbox`; returns what it found."""
        env = {
            "PATH": "/usr/local/bin:/usr/bin:/bin",
            "PYTHONPATH": f"{self._source}:{self._source / 'tests'}",
            "XDG_RUNTIME_DIR": str(self.folder),
            "RCE_SECRET": "the secret of the engine",
        }
        work = tempfile.mkdtemp(dir=self.folder)
        argv = [*self._prefix, self._python, "-m", "support.sandbox", f"{work}/m", self.runtime, *words]
        os.chown(work, self.uid, self.uid)
        done = subprocess.run(
            argv, env=env, cwd="/", capture_output=True, text=True, timeout=100, check=False
        )
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout.splitlines()[-1])
        assert isinstance(found, dict)
        return found


@pytest.fixture(scope="session")
def root_person() -> Iterator[Person]:
    if os.geteuid() != 0:
        pytest.skip("needs root")
    folder = Path(tempfile.mkdtemp(prefix="rce-", dir="/tmp"))
    yield Person("root", (), sys.executable, ROOT, folder)
    shutil.rmtree(folder)


@pytest.fixture(scope="session")
def podman_person(root_person: Person) -> Person:
    """The same with podman, which has the machine's programs where no image is named."""
    person = copy(root_person)
    person.runtime = "podman"
    return person


@pytest.fixture(scope="session")
def normal_person() -> Iterator[Person]:
    """A user with a Python of their own: the engine's may lie where nobody else can read it."""
    if os.geteuid() != 0:
        name = pwd.getpwuid(os.geteuid()).pw_name
        folder = Path(tempfile.mkdtemp(prefix="rce-", dir="/tmp"))
        yield Person(name, (), sys.executable, ROOT, folder)
        shutil.rmtree(folder)
        return
    wanted = f"{sys.version_info.major}.{sys.version_info.minor}"
    version = "import sys; print('%d.%d' % sys.version_info[:2])"
    found = subprocess.run([SYSTEM_PYTHON, "-c", version], capture_output=True, text=True, check=False)
    if found.stdout.strip() != wanted:
        pytest.skip(
            f"{SYSTEM_PYTHON} is no Python {wanted}, so it cannot use the packages that are installed"
        )
    subprocess.run(["useradd", "--system", "--no-create-home", USER], check=False, capture_output=True)
    folder = Path(tempfile.mkdtemp(prefix="rce-", dir="/tmp"))
    folder.chmod(0o755)
    python = _copy_engine(folder)
    home = folder / "home"
    home.mkdir()
    person = pwd.getpwnam(USER)
    os.chown(home, person.pw_uid, person.pw_gid)
    prefix = ("setpriv", f"--reuid={person.pw_uid}", f"--regid={person.pw_gid}", "--clear-groups")
    yield Person(USER, prefix, python, folder / "source", home)
    shutil.rmtree(folder)
    subprocess.run(["userdel", USER], check=False, capture_output=True)


def _copy_engine(folder: Path) -> str:
    """Copy the engine with all that it imports; returns a Python that finds it."""
    subprocess.run([SYSTEM_PYTHON, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    source = next(path for path in map(Path, sys.path) if path.name == "site-packages" and path.is_dir())
    site.rmdir()
    if subprocess.run(["cp", "-al", source, site], capture_output=True, check=False).returncode:
        shutil.rmtree(site, ignore_errors=True)
        subprocess.run(["cp", "-a", source, site], check=True)
    for name in ("rce", "rce_container", "examples", "configs", "tests/support"):
        shutil.copytree(ROOT / name, folder / "source" / name, ignore=shutil.ignore_patterns("__pycache__"))
    return str(folder / "venv" / "bin" / "python")


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
    """What a node said that the cradle forked, and one that was executed."""
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
