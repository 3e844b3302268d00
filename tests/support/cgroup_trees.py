"""Trees of files like those of cgroups, with the texts that kernels write; for limits without a kernel."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rce_container.limits import files

CHILD2 = {
    "memory": {
        "memory.current": "31457280\n",
        "memory.max": "max\n",
        "memory.swap.max": "max\n",
        "memory.oom.group": "0\n",
        "memory.peak": "41943040\n",
        "memory.events": "low 0\nhigh 0\nmax 12\noom 2\noom_kill 2\noom_group_kill 0\n",
        "memory.stat": (
            "anon 20971520\nfile 10485760\nkernel 1048576\nshmem 4194304\n"
            "inactive_anon 0\nactive_anon 25165824\ninactive_file 4194304\nactive_file 2097152\n"
        ),
    },
    "pids": {"pids.max": "max\n", "pids.current": "3\n", "pids.events": "max 7\n"},
    "cpu": {"cpu.max": "max 100000\n", "cpu.weight": "100\n"},
    "io": {
        "io.stat": (
            "8:0 rbytes=4096 wbytes=8192 rios=1 wios=2 dbytes=0 dios=0\n"
            "259:0 rbytes=1 wbytes=2 rios=1 wios=1 dbytes=0 dios=0\n"
        )
    },
}
CPU_STAT2 = (
    "usage_usec 2500000\nuser_usec 2000000\nsystem_usec 500000\n"
    "nr_periods 40\nnr_throttled 10\nthrottled_usec 750000\n"
)


class Tree2:
    """A hierarchy of version 2 in a folder: cgroups get their files when they are made.

    Attributes:
        own: The cgroup of this process.
    """

    def __init__(
        self,
        folder: Path,
        monkeypatch: pytest.MonkeyPatch,
        *,
        controllers: str,
        own: str,
        of_root: str = "cpu memory pids io",
    ) -> None:
        self.root = folder / "cgroup"
        self.own = self.root / own
        self.proc = folder / "proc"
        self.proc.mkdir()
        (self.proc / "cgroup").write_text(f"0::/{own}\n")
        (self.proc / "mountinfo").write_text(f"30 22 0:26 / {self.root} rw - cgroup2 cgroup2 rw\n")
        monkeypatch.setattr(files, "make", self.make)
        monkeypatch.setattr(files, "remove", self.remove)
        monkeypatch.setattr(files, "write", self._write)
        for path in (self.root, *reversed([p for p in (self.own, *self.own.parents) if p > self.root])):
            path.mkdir(exist_ok=True)
            self.fill(path, of_root if path == self.root and own else controllers)
        self.busy = set[Path]()
        """Cgroups that hold processes, and so cannot give controllers away."""

    def make(self, folder: Path) -> None:
        if folder.is_dir():
            return
        folder.mkdir()
        self.fill(folder, (folder.parent / "cgroup.subtree_control").read_text())

    def remove(self, folder: Path) -> None:
        if any(one.is_dir() for one in folder.iterdir()) or (folder / "cgroup.procs").read_text():
            raise OSError(16, "Device or resource busy")
        shutil.rmtree(folder)

    def fill(self, folder: Path, controllers: str) -> None:
        texts = {
            "cgroup.controllers": controllers,
            "cgroup.subtree_control": "",
            "cgroup.procs": "",
            "cgroup.kill": "",
            "cpu.stat": CPU_STAT2,
        }
        if folder != self.root:
            texts["cgroup.type"] = "domain\n"
            for name in controllers.split():
                texts |= CHILD2.get(name, {})
        for name, text in texts.items():
            (folder / name).write_text(text)

    def _write(self, path: Path, value: int | str) -> None:
        if not path.exists():
            raise FileNotFoundError(2, "No such file or directory", str(path))
        if path.name == "cgroup.subtree_control":
            if path.parent in self.busy:
                raise OSError(16, "Device or resource busy", str(path))
            wanted = [word.removeprefix("+") for word in str(value).split()]
            value = " ".join(dict.fromkeys([*path.read_text().split(), *wanted]))
        elif path.name == "cgroup.procs":
            self.busy.discard(path.parent.parent)
            (path.parent.parent / path.name).write_text("")
            value = f"{path.read_text()}{value}\n"
        path.write_text(str(value))
