"""Limits by cgroups of version 2, on a tree of files like the kernel's."""

from __future__ import annotations

import errno
import os
import resource
import shutil
from pathlib import Path

import pytest
from support.cgroup_trees import Tree2

from rce_container.exceptions import LimitError, LimitsUnavailableError
from rce_container.limits import Limits, choose_limiter, files
from rce_container.limits.base import Troubles
from rce_container.limits.cgroup2 import Cgroup2, ControlGroupV2

MB = 1 << 20
ALL = "cpuset cpu io memory hugetlb pids"
LIMITS = Limits(cpu=0.5, memory=64 * MB, processes=32, weight=200)


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tree2:
    return Tree2(tmp_path, monkeypatch, controllers=ALL, own="system.slice/rce.service")


def limiter(tree: Tree2) -> Cgroup2:
    made = Cgroup2("t0", tree.proc.parent / "ledger", tree.proc)
    made.probe()
    return made


def text(path: Path, name: str) -> str:
    return (path / name).read_text()


def test_a_container_gets_a_cgroup_with_its_limits(tree: Tree2) -> None:
    control_group = limiter(tree).create("m1", LIMITS)
    folder = tree.own / "rce-t0" / "m1"
    assert control_group.join == (str(folder / "cgroup.procs"),)
    assert text(folder, "memory.max") == str(64 * MB)
    assert text(folder, "memory.swap.max") == "0"
    assert text(folder, "memory.oom.group") == "0\n", "the kernel kills one process, not the container"
    assert text(folder, "pids.max") == "32"
    assert text(folder, "cpu.max") == "50000 100000"
    assert text(folder, "cpu.weight") == "200"
    assert control_group.rlimits == {}
    assert text(tree.own, "cgroup.subtree_control").split() == ["memory", "pids", "cpu", "io"]


def test_no_limit_is_written_as_such(tree: Tree2) -> None:
    control_group = limiter(tree).create("m1", LIMITS)
    control_group.apply(Limits())
    folder = tree.own / "rce-t0" / "m1"
    assert [text(folder, name) for name in ("memory.max", "memory.swap.max", "pids.max", "cpu.max")] == [
        "max",
        "max",
        "max",
        "max 100000",
    ]


def test_processes_of_the_own_cgroup_make_room(tree: Tree2) -> None:
    tree.busy.add(tree.own)
    (tree.own / "cgroup.procs").write_text("11\n12\n")
    limiter(tree).create("m1", LIMITS)
    assert text(tree.own / "rce-engine", "cgroup.procs") == "11\n12\n"


def test_a_program_that_made_room_before_works_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = Tree2(tmp_path, monkeypatch, controllers=ALL, own="system.slice/rce.service/rce-engine")
    control_group = limiter(tree).create("m1", LIMITS)
    assert control_group.join == (str(tree.own.parent / "rce-t0" / "m1" / "cgroup.procs"),)


def test_a_cgroup_that_vanishes_as_it_is_killed_is_empty(
    tree: Tree2, monkeypatch: pytest.MonkeyPatch
) -> None:
    control_group = limiter(tree).create("m1", LIMITS)
    folder = tree.own / "rce-t0" / "m1"
    (folder / "cgroup.procs").write_text("4194305\n")

    def vanish(path: Path, _: int | str) -> None:
        shutil.rmtree(folder)
        raise OSError(errno.ENODEV, "No such device", str(path))

    monkeypatch.setattr(files, "write", vanish)
    control_group.kill()
    assert not folder.exists()


def test_usage_and_troubles_are_read(tree: Tree2) -> None:
    control_group = limiter(tree).create("m1", LIMITS)
    usage = control_group.usage()
    assert (usage.cpu_s, usage.throttled_s) == (2.5, 0.75)
    assert usage.memory == 31457280 - 4194304, "files that are only cached do not count"
    assert usage.memory_peak == 41943040
    assert (usage.io_read, usage.io_written) == (4097, 8194)
    assert control_group.troubles() == Troubles(oom_kills=2, refused_forks=7)


def test_unusual_lines_of_counters_are_left_out(tree: Tree2) -> None:
    """Some kernels print several disks in one line; statistics for debugging have words as values."""
    control_group = limiter(tree).create("m1", LIMITS)
    folder = tree.own / "rce-t0" / "m1"
    (folder / "io.stat").write_text(
        "7:7 7:6 7:5 7:4 rbytes=28672 wbytes=0 rios=7 wios=0 dbytes=0 dios=0\n"
        "8:0 rbytes=4096 wbytes=8192 use_delay=0 depth=max\n"
    )
    (folder / "memory.events").write_text("oom max\noom_kill 3\n")
    usage = control_group.usage()
    assert (usage.io_read, usage.io_written) == (32768, 8192)
    assert control_group.troubles().oom_kills == 3


def test_memory_is_not_limited_to_less_than_is_needed(tree: Tree2) -> None:
    control_group = limiter(tree).create("m1", LIMITS)
    with pytest.raises(LimitError, match=r"cannot be limited to 20 MB: it needs 24 MB now; stop some of its"):
        control_group.apply(LIMITS._replace(memory=20 * MB))
    assert control_group.limits == LIMITS
    assert text(tree.own / "rce-t0" / "m1", "memory.max") == str(64 * MB)
    control_group.apply(LIMITS._replace(memory=25 * MB))
    assert text(tree.own / "rce-t0" / "m1", "memory.max") == str(25 * MB)


def test_a_refused_limit_leaves_the_old_ones(tree: Tree2) -> None:
    control_group = limiter(tree).create("m1", LIMITS)
    folder = tree.own / "rce-t0" / "m1"
    (folder / "cpu.weight").unlink()
    with pytest.raises(LimitError, match=r"the kernel refuses its limits: .*cpu.weight"):
        control_group.apply(LIMITS._replace(cpu=1.0))
    assert text(folder, "cpu.max") == "50000 100000"


def test_the_kernel_kills(tree: Tree2) -> None:
    control_group = limiter(tree).create("m1", LIMITS)
    folder = tree.own / "rce-t0" / "m1"
    control_group.kill()
    assert text(folder, "cgroup.kill") == "", "nothing to kill"
    (folder / "cgroup.procs").write_text(f"{os.getpid()}\n")
    control_group.kill()
    assert text(folder, "cgroup.kill") == "", "never this program itself"


def test_a_cell_is_removed_with_what_is_below_it(tree: Tree2) -> None:
    made = limiter(tree)
    control_group = made.create("m1", LIMITS)
    tree.make(tree.own / "rce-t0" / "m1" / "inner")
    control_group.remove()
    assert not (tree.own / "rce-t0" / "m1").exists()
    control_group.remove()
    made.close()
    assert not (tree.own / "rce-t0").exists()


def test_a_cell_with_a_process_is_not_removed(tree: Tree2, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_container.limits.cgroup._REMOVE_TIMEOUT_S", 0.0)
    made = limiter(tree)
    control_group = made.create("m1", LIMITS)
    (tree.own / "rce-t0" / "m1" / "cgroup.procs").write_text("1\n")
    with pytest.raises(LimitError, match="cannot be removed"):
        control_group.remove()
    made.close()
    assert (tree.own / "rce-t0").is_dir()


def test_next_manager_adopts_and_sweeps_from_anywhere(tree: Tree2) -> None:
    """The next manager adopts and sweeps wherever it is started."""
    first = limiter(tree)
    first.sweep(())
    for incarnation_id in ("m1", "m2"):
        first.create(incarnation_id, LIMITS)
    tree.make(tree.own / "rce-other")
    tree.make(tree.own / "rce-other" / "m3")
    before = tree.own
    elsewhere = tree.root / "user.slice"
    elsewhere.mkdir()
    tree.fill(elsewhere, ALL)
    (tree.proc / "cgroup").write_text("0::/user.slice\n")
    second = limiter(tree)
    assert second.adopt("m1").limits == LIMITS
    second.sweep({"m1"})
    assert (before / "rce-t0" / "m1").is_dir()
    assert not (before / "rce-t0" / "m2").exists()
    assert (before / "rce-other" / "m3").is_dir(), "another task set's"
    second.sweep(())
    assert not (before / "rce-t0").exists()
    assert (tree.proc.parent / "ledger").read_text() == f"{elsewhere}/rce-t0\n"


def test_a_container_without_a_cgroup_cannot_be_resized(tree: Tree2) -> None:
    control_group = limiter(tree).adopt("unknown")
    assert (control_group.join, control_group.pids()) == ((), [])
    with pytest.raises(LimitError, match="destroy it and create it again"):
        control_group.apply(LIMITS)
    control_group.kill()
    control_group.remove()


def test_the_task_set_s_folder_is_there_while_it_has_containers(tree: Tree2) -> None:
    made = limiter(tree)
    control_groups = [made.create(incarnation_id, LIMITS) for incarnation_id in ("m1", "m2")]
    for control_group in control_groups:
        assert (tree.own / "rce-t0").is_dir()
        control_group.remove()
    assert not (tree.own / "rce-t0").exists()
    made.create("m3", LIMITS)
    assert text(tree.own / "rce-t0" / "m3", "pids.max") == "32"


def test_a_folder_that_vanishes_meanwhile_is_made_again(tree: Tree2, monkeypatch: pytest.MonkeyPatch) -> None:
    made = limiter(tree)
    make = tree.make
    spoiled: list[Path] = []

    def spoil(folder: Path) -> None:
        if folder.name == "m1" and not spoiled:
            spoiled.append(folder)
            tree.remove(folder.parent)
            raise FileNotFoundError(2, "No such file or directory", str(folder))
        make(folder)

    monkeypatch.setattr("rce_container.limits.files.make", spoil)
    made.create("m1", LIMITS)
    assert spoiled
    assert text(tree.own / "rce-t0" / "m1", "pids.max") == "32"


def test_missing_controllers_are_said_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = Tree2(tmp_path, monkeypatch, controllers="cpu pids", own="user.slice")
    made = limiter(tree)
    assert made.missing == {"memory", "io"}
    assert made.detail.startswith("of containers' io, memory no limit holds")
    control_group = made.create("m1", LIMITS)
    assert control_group.rlimits == {resource.RLIMIT_DATA: 64 * MB}
    assert control_group.usage().memory is None


@pytest.mark.parametrize("controllers", ["", "cpuset hugetlb"])
def test_a_cgroup_without_controllers_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, controllers: str
) -> None:
    tree = Tree2(tmp_path, monkeypatch, controllers=controllers, own="user.slice")
    with pytest.raises(LimitsUnavailableError, match=r"has no controllers; .*Delegate=yes"):
        limiter(tree)
    chosen = choose_limiter("t0", tmp_path / "ledger", tree.proc)
    assert chosen.name == "rlimit"
    assert "no controllers" in chosen.detail


def test_machine_with_cgroup1_controllers_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with all controllers in the first version says so."""
    tree = Tree2(tmp_path, monkeypatch, controllers="", own="user.slice", of_root="hugetlb")
    with pytest.raises(LimitsUnavailableError, match="all controllers belong to version 1"):
        limiter(tree)


def test_a_cgroup_of_somebody_else_is_refused(tree: Tree2, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, value: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("rce_container.limits.files.write", refuse)
    with pytest.raises(LimitsUnavailableError, match="may not be used: Permission denied"):
        limiter(tree)


def test_the_engine_s_own_limits_are_the_ceiling(tree: Tree2) -> None:
    (tree.own / "memory.max").write_text(str(512 * MB))
    (tree.own.parent / "memory.max").write_text(str(256 * MB))
    (tree.own / "cpu.max").write_text("150000 100000\n")
    assert limiter(tree).ceiling() == Limits(cpu=1.5, memory=256 * MB)


def test_the_best_way_is_chosen(tree: Tree2) -> None:
    chosen = choose_limiter("t0", tree.proc.parent / "ledger", tree.proc)
    assert isinstance(chosen, Cgroup2)
    assert chosen.detail == ""


def test_the_root_needs_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = Tree2(tmp_path, monkeypatch, controllers=ALL, own="")
    limiter(tree).create("m1", LIMITS)
    assert not (tree.root / "rce-engine").exists()
    assert int(text(tree.root / "rce-t0", "cpu.weight")) == min(10_000, 400 * (os.cpu_count() or 1))


def test_cpu_quota_is_at_least_the_kernels_minimum(tree: Tree2) -> None:
    """Fractions of a period are at least what the kernel takes."""
    limiter(tree).create("m1", Limits(cpu=0.001))
    assert ControlGroupV2([tree.own / "rce-t0" / "m1"]).limits.cpu == 0.01
