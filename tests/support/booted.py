"""A machine that systemd runs: this one's files under an overlay, in namespaces and cgroups of their own.

Nothing that happens in it changes this machine. Its network is a loopback interface, or one that was made.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shlex
import subprocess
import tempfile
from collections.abc import AsyncIterator, Iterator
from functools import partial
from pathlib import Path

from support.engine import until

SYSTEMD = Path("/lib/systemd/systemd")
_CGROUPS = Path("/sys/fs/cgroup")
_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

_BOOT = r"""
set -e
name=$1; shift
for folder in "$@"; do
    mkdir -p "$folder/$name"
    for file in cpuset.cpus cpuset.mems; do
        if [ -e "$folder/$name/$file" ] && [ -z "$(cat "$folder/$name/$file")" ]; then
            cat "$folder/$file" >"$folder/$name/$file" || true
        fi
    done
    echo $$ >"$folder/$name/cgroup.procs"
done
if [ -n "$NETWORK" ]; then enter="nsenter --net=$NETWORK"; else enter="unshare --net"; fi
exec $enter unshare --fork --pid --mount --ipc --uts --cgroup --mount-proc --kill-child=SIGKILL \
    sh -ec "$INSIDE"
"""

_INSIDE = r"""
mount --make-rprivate /
if [ -n "$DISK" ]; then mount --bind "$DISK" /mnt; else mount -t tmpfs tmpfs /mnt; fi
mkdir -p /mnt/upper /mnt/work /mnt/root
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
cd /mnt/root
mount -t proc proc proc
mount -t sysfs -o ro sysfs sys
mount -t tmpfs -o mode=755 tmpfs dev
for name in null zero full random urandom tty net/tun; do
    [ -e /dev/$name ] || continue
    mkdir -p dev/$(dirname $name); touch dev/$name; mount --bind /dev/$name dev/$name
done
mkdir dev/pts dev/shm
mount -t devpts -o newinstance,ptmxmode=666 devpts dev/pts
ln -s pts/ptmx dev/ptmx
ln -s /proc/self/fd dev/fd
mount -t tmpfs tmpfs dev/shm
mount -t tmpfs -o mode=755 tmpfs run
mount -t tmpfs tmpfs tmp
if grep -qv '^0:' /proc/self/cgroup; then
    mount -t tmpfs -o mode=755 tmpfs sys/fs/cgroup
    while IFS=: read -r number names path; do
        [ "$number" != 0 ] || continue
        folder=sys/fs/cgroup/${names#name=}
        case "$names" in name=*) names=none,$names ;; esac
        mkdir "$folder"; mount -t cgroup -o "$names" cgroup "$folder"
    done </proc/self/cgroup
else
    mount -t cgroup2 cgroup2 sys/fs/cgroup
fi
if [ ! -e /mnt/begun ]; then
rm -rf etc/systemd/system var/log/journal etc/rce var/lib/rce
mkdir etc/systemd/system
: >etc/fstab
echo 0123456789abcdef0123456789abcdef >etc/machine-id
for unit in systemd-udevd.service systemd-logind.service systemd-networkd.service systemd-resolved.service \
    systemd-timesyncd.service getty.target console-getty.service proc-sys-fs-binfmt_misc.automount; do
    ln -s /dev/null etc/systemd/system/$unit
done
touch /mnt/begun
fi
ip link set lo up
mkdir -p .former
pivot_root . .former
umount -l /.former
mount --make-rshared /
exec env -i container=other PATH=$PATH /lib/systemd/systemd --system --unit=multi-user.target
"""


class Booted:
    """The machine, while it runs."""

    def __init__(self, init: int, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self._enter = ["nsenter", f"--target={init}", "--all", "--root", "--wd", "--", "env", "-i"]

    def run(self, command: str, *, code: int | None = 0, stdin: str = "") -> str:
        """Run a line of shell in it; returns what it prints.

        Args:
            command: The line.
            code: The exit code that it has to have; None for any.
            stdin: What it reads.
        """
        done = subprocess.run(
            [*self._enter, f"PATH={_PATH}", "LANG=C.UTF-8", "HOME=/root", "COLUMNS=300", "sh", "-c", command],
            input=stdin,
            capture_output=True,
            text=True,
            check=False,
        )
        said = done.stdout + done.stderr
        assert code is None or done.returncode == code, f"{command}: {done.returncode}\n{said}"
        return said

    async def run_soon(self, command: str, *, code: int | None = 0, stdin: str = "") -> str:
        """As :meth:`run`, in a thread."""
        return await asyncio.to_thread(self.run, command, code=code, stdin=stdin)

    async def reboot(self) -> None:
        """Reboot it; it ends then, and the next machine with its disk is the same one."""
        await self.run_soon("systemctl reboot", code=None)
        await self._process.wait()

    def let_enter(self, *places: str) -> None:
        """Let all users enter the folders of these places, wherever they are installed."""
        folders = {str(folder) for place in places for folder in Path(place).parents}
        self.run(f"chmod o+x {shlex.join(folders)}")

    def journal(self, unit: str) -> str:
        """The unit's log."""
        return self.run(f"journalctl --no-pager -o cat -u {shlex.quote(unit)}")


@contextlib.asynccontextmanager
async def booted(number: int = 0, *, network: str = "", disk: Path | None = None) -> AsyncIterator[Booted]:
    """Boot the machine, and take it away again, as by a loss of power if it runs.

    Args:
        number: One for each machine that runs at the same time.
        network: The network namespace that it is in; empty for one of its own.
        disk: Folder that keeps its files, on a file system that overlays can be on; None: they end with it.
    """
    name = f"rce-booted-{os.getpid()}-{number}"
    place = {"NETWORK": f"/run/netns/{network}" if network else "", "DISK": str(disk or "")}
    with tempfile.TemporaryFile() as console:
        process = await asyncio.create_subprocess_exec(
            *("sh", "-c", _BOOT, "sh", name, *map(str, _hierarchies())),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=console,
            stderr=console,
            env={"PATH": _PATH, "INSIDE": _INSIDE, **place},
            start_new_session=True,
        )
        try:

            def init() -> int:
                assert process.returncode is None, _tail(console.fileno())
                children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
                with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a step that has just ended
                    if children and Path(f"/proc/{children[0]}/comm").read_text() == "systemd\n":
                        return int(children[0])
                return 0

            machine = Booted(await until(init, what="systemd starts"), process)
            state = "systemctl is-system-running --wait"
            await until(lambda: "running" in machine.run(state, code=None), what="systemd has booted")
            try:
                yield machine
            except BaseException:
                if process.returncode is None:
                    print(machine.run("journalctl --no-pager -o cat | tail -n 80", code=None))  # noqa: T201
                raise
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            for hierarchy in _hierarchies():
                await until(partial(_remove, hierarchy / name), what=f"{name} is removed")


def _tail(fd: int) -> str:
    return os.pread(fd, 1 << 16, 0).decode(errors="replace")[-4000:]


def _hierarchies() -> Iterator[Path]:
    """Where this machine's hierarchies of cgroups are."""
    for line in Path("/proc/mounts").read_text().splitlines():
        _, point, kind, *_ = line.split()
        if kind in ("cgroup", "cgroup2") and Path(point).is_relative_to(_CGROUPS):
            yield Path(point)


def _remove(top: Path) -> bool:
    """Remove a cgroup and those in it; says whether it is gone."""
    for folder, _, _ in os.walk(top, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(folder)  # noqa: PTH106 - a cgroup's files go with it
    return not top.exists()
