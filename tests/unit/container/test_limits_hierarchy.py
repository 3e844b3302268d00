"""Where a process finds its cgroups, with the texts of real machines."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce_container.limits import hierarchy

SYSTEMD_V2 = """\
22 1 0:21 / /sys rw,nosuid,nodev,noexec,relatime shared:7 - sysfs sysfs rw
30 22 0:26 / ROOT rw,nosuid,nodev,noexec,relatime shared:9 - cgroup2 cgroup2 rw,nsdelegate
"""
HYBRID = """\
31 22 0:27 / /sys/fs/cgroup ro,nosuid,nodev,noexec shared:9 - tmpfs tmpfs ro,mode=755
32 31 0:28 / ROOT/unified rw,nosuid shared:10 - cgroup2 cgroup2 rw,nsdelegate
33 31 0:29 / ROOT/systemd rw,nosuid shared:11 - cgroup cgroup rw,xattr,name=systemd
36 31 0:32 / ROOT/cpu,cpuacct rw,nosuid shared:15 - cgroup cgroup rw,cpu,cpuacct
37 31 0:33 / ROOT/memory rw,nosuid shared:16 - cgroup cgroup rw,memory
38 31 0:34 / ROOT/pids rw,nosuid shared:17 - cgroup cgroup rw,pids
"""
HYBRID_MEMBER = """\
12:pids:/user.slice/user-1000.slice
5:cpu,cpuacct:/user.slice
4:memory:/user.slice
1:name=systemd:/user.slice/user-1000.slice/session-2.scope
0::/user.slice/user-1000.slice/session-2.scope
"""
DOCKER_V1 = "41 31 0:33 /docker/abc ROOT/memory ro,nosuid,relatime master:16 - cgroup cgroup rw,memory\n"


@pytest.fixture
def proc(tmp_path: Path) -> Path:
    (tmp_path / "proc").mkdir()
    return tmp_path / "proc"


def write(proc: Path, membership: str, mounts: str, *folders: str) -> Path:
    root = proc.parent / "cg"
    for folder in folders:
        (root / folder).mkdir(parents=True)
    (proc / "cgroup").write_text(membership)
    (proc / "mountinfo").write_text(mounts.replace("ROOT", str(root)))
    return root


def test_a_service_in_a_pure_second_version(proc: Path) -> None:
    root = write(proc, "0::/system.slice/rce.service\n", SYSTEMD_V2, "system.slice/rce.service")
    (found,) = hierarchy.find(proc)
    assert found == hierarchy.Hierarchy(2, frozenset(), root, root / "system.slice/rce.service")


def test_each_controller_has_its_own_place_in_the_first_version(proc: Path) -> None:
    folders = (
        "unified/user.slice/user-1000.slice/session-2.scope",
        "cpu,cpuacct/user.slice",
        "memory/user.slice",
        "pids/user.slice/user-1000.slice",
    )
    root = write(proc, HYBRID_MEMBER, HYBRID, *folders)
    found = {one.controllers: one for one in hierarchy.find(proc)}
    assert found[frozenset({"cpu", "cpuacct"})].folder == root / "cpu,cpuacct/user.slice"
    assert found[frozenset({"memory"})].folder == root / "memory/user.slice"
    assert found[frozenset({"pids"})].mount == root / "pids"
    assert found[frozenset()].version == 2
    assert len(found) == 4, "the hierarchy of systemd itself has no controllers"


def test_a_container_sees_its_subtree_mounted_as_the_whole(proc: Path) -> None:
    root = write(proc, "4:memory:/docker/abc/inner\n", DOCKER_V1, "memory/inner")
    (found,) = hierarchy.find(proc)
    assert found.folder == root / "memory/inner"


@pytest.mark.parametrize(
    ("membership", "mounts"),
    [
        ("0::/../../other\n", SYSTEMD_V2),
        ("0::/\n", SYSTEMD_V2.replace("0:26 /", "0:26 /../..")),
        ("4:memory:/docker/abcdef\n", DOCKER_V1),
        ("0::/system.slice/gone.service (deleted)\n", SYSTEMD_V2),
        ("", ""),
    ],
)
def test_what_cannot_be_reached_is_left_out(proc: Path, membership: str, mounts: str) -> None:
    write(proc, membership, mounts, "memory")
    assert hierarchy.find(proc) == []


def test_the_first_mount_that_shows_this_process_counts(proc: Path) -> None:
    part = "29 22 0:26 /elsewhere ROOT/part rw - cgroup2 cgroup2 rw\n"
    root = write(proc, "0::/here\n", part + SYSTEMD_V2, "here", "part")
    (found,) = hierarchy.find(proc)
    assert found.folder == root / "here"


def test_paths_are_unescaped() -> None:
    (mount,) = hierarchy.parse_mounts("30 22 0:26 / /my\\040groups\\134x rw - cgroup2 cgroup2 rw\n")
    assert mount.point == Path("/my groups\\x")


def test_a_path_may_hold_colons() -> None:
    (one,) = hierarchy.parse_memberships("0::/a:b/c\n")
    assert one.path == "/a:b/c"


def test_without_proc_there_is_nothing(tmp_path: Path) -> None:
    assert hierarchy.find(tmp_path) == []
