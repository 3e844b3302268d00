"""The runtime of Linux namespaces, made by bubblewrap.

A container has its own user, pid, mount, network, ipc, uts and cgroup namespaces. Its root is read-only and
holds the
system's programs, the engine's Python and the packages; its home and /tmp are private. The environment is
process 1: when it dies, however that happens, the kernel kills every other process of the container. Shim,
bubblewrap and environment are tied to each other, so that none outlives the one outside of it.
"""

from __future__ import annotations

import compileall
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from rce_container.environment.messages import Boot
from rce_container.exceptions import RuntimeUnavailableError
from rce_container.folder import ContainerFolder
from rce_container.runtimes.base import Order, Runtime, clean_environ, source_root

USER = "rce"
USER_ID = 1000
HOME = f"/home/{USER}"
LOGS = "/var/log/rce"
TMP_BYTES = 256 << 20

_SYSTEM = ("/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32")
_ETC = (
    "ld.so.cache",
    "ld.so.conf",
    "ld.so.conf.d",
    "alternatives",
    "localtime",
    "timezone",
    "python3",
    "ros",
)
_PROBE_TIMEOUT_S = 20.0
_MAX_HOSTNAME = 63


class NamespaceRuntime(Runtime):
    """Isolation by namespaces, as root and as any user who may make user namespaces."""

    name = "namespace"
    isolated = True

    def __init__(self) -> None:
        self._bwrap = shutil.which("bwrap") or ""
        self._options = ""

    def probe(self) -> None:
        """Make a namespace like a container's and start the engine's Python in it."""
        if not sys.platform.startswith("linux"):
            raise RuntimeUnavailableError(self.name, "it needs Linux")
        if not self._bwrap:
            raise RuntimeUnavailableError(
                self.name, "bwrap is not installed (Debian, Ubuntu: apt install bubblewrap)"
            )
        self._options = _run([self._bwrap, "--help"]).stdout
        _compile()
        with tempfile.TemporaryDirectory() as scratch:
            folder = ContainerFolder(Path(scratch), Path(scratch) / "run", "0" * 12)
            folder.make()
            boot = Boot(
                id="probe/probe", mark=folder.mark, machine="", home="", logs="", ros_port=0, isolated=True
            )
            order = Order("probe", boot, folder, (), 0, 0)
            argv, env = self.command(order, [sys.executable, "-c", "import rce_container.environment"])
            found = _run(argv, env)
        if found.returncode:
            words = found.stderr.strip().splitlines()
            raise RuntimeUnavailableError(self.name, words[-1] if words else f"exit code {found.returncode}")

    def paths(self, folder: ContainerFolder) -> tuple[str, str]:  # noqa: ARG002
        """The same in every container."""
        return HOME, LOGS

    def command(self, order: Order, argv: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        """Run it in a sandbox."""
        folder = order.folder
        _write_etc(folder.etc, order.tag)
        environ = clean_environ(HOME)
        environ["USER"] = environ["LOGNAME"] = USER
        options = [
            *("--unshare-user", "--unshare-pid", "--unshare-net", "--unshare-ipc", "--unshare-uts"),
            *("--unshare-cgroup-try", "--as-pid-1", "--die-with-parent", "--new-session"),
            *("--cap-drop", "ALL", "--uid", str(USER_ID), "--gid", str(USER_ID)),
            *("--hostname", order.tag[:_MAX_HOSTNAME]),
            *self._mounts(order),
            *("--chdir", HOME),
        ]
        return [self._bwrap, *options, "--", *argv], environ

    def _mounts(self, order: Order) -> list[str]:
        folder = order.folder
        limit = ("--size", str(TMP_BYTES)) if "--size" in self._options else ()
        return [
            *_system(),
            *("--proc", "/proc", "--dev", "/dev"),
            *(*limit, "--tmpfs", "/tmp"),  # noqa: S108 - the container's own
            *("--ro-bind", str(folder.etc), "/etc"),
            *(word for name in _ETC for word in ("--ro-bind-try", f"/etc/{name}", f"/etc/{name}")),
            *("--bind", str(folder.home), HOME, "--bind", str(folder.logs), LOGS),
            *_read_only([*interpreter_paths(), *order.packages]),
            *("--symlink", "../tmp", "/var/tmp", "--remount-ro", "/"),  # noqa: S108
        ]


def interpreter_paths() -> list[Path]:
    """All that the engine's Python needs to be seen inside, as paths of the machine."""
    root = source_root()
    wanted = [Path(sys.prefix), Path(sys.base_prefix), Path(sys.base_exec_prefix)]
    wanted.append(Path(sys.executable).resolve().parents[1])
    return [*wanted, *(path.resolve() for path in wanted), root / "rce", root / "rce_container"]


def _compile() -> None:
    """Have the modules compiled here: inside nothing can be written, and every container would do it anew."""
    for package in ("rce", "rce_container"):
        compileall.compile_dir(source_root() / package, quiet=2)


def _system() -> list[str]:
    """The machine's programs and libraries."""
    options = ["--ro-bind", "/usr", "/usr"]
    for path in map(Path, _SYSTEM):
        if path.is_symlink():
            options += ["--symlink", str(path.readlink()), str(path)]
        elif path.is_dir():
            options += ["--ro-bind", str(path), str(path)]
    return [*options, "--ro-bind-try", "/opt/ros", "/opt/ros"]


def _read_only(paths: Iterable[Path]) -> list[str]:
    """Bind paths where they are, leaving out what lies inside another one or inside the system's."""
    bound = [Path("/usr")]
    options: list[str] = []
    for path in sorted({path.absolute() for path in paths}, key=lambda path: len(path.parts)):
        if path == Path("/") or any(path.is_relative_to(outer) for outer in bound) or not path.exists():
            continue
        bound.append(path)
        options += ["--ro-bind", str(path), str(path)]
    return options


def _write_etc(etc: Path, tag: str) -> None:
    host = tag[:_MAX_HOSTNAME]
    for name, text in (
        ("passwd", f"{USER}:x:{USER_ID}:{USER_ID}::{HOME}:/bin/sh\n"),
        ("group", f"{USER}:x:{USER_ID}:\n"),
        ("hosts", f"127.0.0.1 localhost {host}\n"),
        ("hostname", f"{host}\n"),
        ("nsswitch.conf", "passwd: files\ngroup: files\nhosts: files\n"),
    ):
        (etc / name).write_text(text)
    for name in _ETC:
        source = Path("/etc") / name
        if source.is_dir():
            (etc / name).mkdir(exist_ok=True)
        elif source.exists():
            (etc / name).touch()


def _run(argv: Sequence[str], env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(  # noqa: S603
            argv,
            env=env,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RuntimeUnavailableError(NamespaceRuntime.name, str(error)) from error
