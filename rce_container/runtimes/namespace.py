"""The runtime of Linux namespaces: bubblewrap makes them, the fork server's children run in them.

A container has its own user, pid, mount, network, ipc, uts and cgroup namespaces. Its root is read-only and
holds the system's programs, the engine's Python and the packages; its home and /tmp live in memory and are
limited. Process 1 is the *holder*, a shell that waits for the environment's last message: when the
environment ends for any reason, the holder ends, and the kernel kills every other process of the container.
Shim, bubblewrap and holder are linked to each other, so that none outlives the one outside of it.
"""

from __future__ import annotations

import asyncio
import compileall
import contextlib
import os
import shutil
import stat
import sys
import tempfile
import threading
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from rce.model.volumes import overlap
from rce.ros.packages import PATH_VARIABLES, distributed_folders
from rce_container.environment.logs.files import ENVIRONMENT_LOG, segment_path
from rce_container.environment.messages import Boot
from rce_container.exceptions import ContainerError, RuntimeUnavailableError, StartError, VolumeError
from rce_container.folder import ContainerFolder, Record
from rce_container.forkserver.confine import USER_ID
from rce_container.forkserver.messages import SpawnRequest, VolumeOrder
from rce_container.forkserver.mounts import HOME, LOGS, TEMPORARY
from rce_container.forkserver.process import ForkServer
from rce_container.network.addresses import hostname, hosts_text
from rce_container.runtimes.base import Order, Runtime, clean_environ, source_root
from rce_container.runtimes.held import HOLDER, HeldHandle
from rce_container.seccomp.library import FilterUnavailableError, make_filter
from rce_container.uids import FIRST_UID, UIDS, UidPool
from rce_container.volumes.store import VolumeMount

USER = "rce"
BUNDLES = "/opt/rce/bundles"
"""Where a container sees the packages that its user brought."""
HOME_BYTES = 256 << 20
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
_PROBE_TIMEOUT_S = 60.0
_NO_USER_NAMESPACES = (
    " (a normal user needs user namespaces for that; see the sysctls user.max_user_namespaces, "
    "kernel.unprivileged_userns_clone and kernel.apparmor_restrict_unprivileged_userns)"
)
_READ_BY_OTHERS = stat.S_IROTH | stat.S_IXOTH


class NamespaceRuntime(Runtime):
    """Isolation by namespaces, as root and as any user who may make user namespaces.

    As root each container runs as a separate user of the machine; else all run as the engine's user.

    Args:
        home_bytes: Size of a container's home.
        uids: The users for containers, as root; None takes the default ones.
        packages: The machine's folders of packages, which are searched once for all containers.
    """

    name = "namespace"
    isolated = True

    def __init__(
        self, *, home_bytes: int = HOME_BYTES, uids: UidPool | None = None, packages: Iterable[Path] = ()
    ) -> None:
        self._home_bytes = home_bytes
        self._packages = os.pathsep.join(map(str, packages))
        self._uids = uids or UidPool(FIRST_UID, UIDS)
        self._root = os.geteuid() == 0
        self._bwrap = shutil.which("bwrap") or ""
        self._fork_server = ForkServer(b"", {})

    def probe(self) -> None:
        """Make a container and start the engine's Python in it."""
        if not sys.platform.startswith("linux"):
            raise RuntimeUnavailableError(self.name, "it needs Linux")
        self.require()
        _compile()
        self._fork_server.close()
        program, missing = _make_filter()
        self.detail = "; ".join(filter(None, (missing, self._claimed())))
        environ = {**clean_environ(HOME), PATH_VARIABLES[0]: self._packages}
        self._fork_server = ForkServer(program, environ)
        failures: list[Exception] = []
        trying = threading.Thread(target=self._try, args=(failures,))  # this thread may run an event loop
        trying.start()
        trying.join()
        if failures:
            self.close()
            raise RuntimeUnavailableError(self.name, str(failures[0])) from failures[0]

    def require(self) -> None:
        """Look for the programs that are needed. Blocks.

        Raises:
            RuntimeUnavailableError: A program is missing.
        """
        if not self._bwrap:
            raise RuntimeUnavailableError(
                self.name, "bwrap is not installed (Debian, Ubuntu: apt install bubblewrap)"
            )

    def user_packages(self, folder: ContainerFolder) -> str:  # noqa: ARG002
        """The same in every container."""
        return BUNDLES

    def is_starting(self, record: Record) -> bool:
        """An environment is noted when the fork server has answered."""
        return not record.environment

    def review(self, packages: Iterable[Path]) -> str:
        """As root, containers run as users who cannot read a private folder."""
        closed = [str(path) for path in packages if self._root and _is_closed(path)]
        if not closed:
            return ""
        return f"containers cannot read {', '.join(closed)}: make it readable by all users (chmod -R o+rX)"

    def _claimed(self) -> str:
        """Return a text about the owners of the containers' users; empty if they have none."""
        owners = self._uids.owners() if self._root else []
        if not owners:
            return ""
        return f"users for containers belong to {', '.join(owners)} too: choose others by --first-uid"

    def close(self) -> None:
        """End the fork server; the containers keep running."""
        self._fork_server.close()

    def start(self, order: Order) -> HeldHandle:
        """Make the container's namespaces; the handle's ``launch`` starts the environment."""
        return self._start(order)

    def _start(self, order: Order, check: tuple[str, ...] = ()) -> HeldHandle:
        check_volumes(order)
        try:
            write_etc(order)
        except OSError as error:
            raise StartError(f"its /etc cannot be written: {error}") from error
        uid, lock = self._uids.take() if self._root else (0, -1)
        request = SpawnRequest(
            boot=order.boot,
            environ={**clean_environ(HOME), "USER": USER, "LOGNAME": USER, **order.volume_variables},
            uid=uid,
            home_bytes=self._home_bytes,
            tmp_bytes=TMP_BYTES,
            host_network=order.host_network,
            join=order.join,
            volumes=tuple(
                VolumeOrder(path=one.path, image=str(one.source) if one.image else "")
                for one in order.volumes
            ),
            check=check,
        )
        try:
            handle = HeldHandle.start(self._command(order), order, request, self._fork_server, lock)
        finally:
            if lock >= 0:
                os.close(lock)
        if not self._root:
            handle.failure += _NO_USER_NAMESPACES
        return handle

    def _try(self, failures: list[Exception]) -> None:
        try:
            asyncio.run(self._try_once())
        except (ContainerError, OSError, TimeoutError) as error:
            failures.append(error)

    async def _try_once(self) -> None:
        """Make a container in which Python checks whether it can import the engine.

        Raises:
            ContainerError: It did not work; the text says why.
        """
        with tempfile.TemporaryDirectory() as scratch:
            folder = ContainerFolder(Path(scratch), Path(scratch) / "run", "0" * 12)
            folder.make()
            boot = Boot(
                id="probe/probe",
                mark=folder.incarnation_id,
                machine="",
                home="",
                logs="",
                ros_port=0,
                isolated=True,
                grace=0,
            )
            with folder.listen(folder.control_socket) as control, folder.listen(folder.link_socket) as links:
                order = Order("probe", boot, folder, (), control.fileno(), links.fileno())
                check = (sys.executable, "-c", "import rce_container.environment")
                handle = self._start(order, check)
                try:
                    async with asyncio.timeout(_PROBE_TIMEOUT_S):
                        await handle.launch()
                except StartError as error:
                    words: list[str] = []
                    with contextlib.suppress(OSError):  # the shim may have removed it already
                        log = segment_path(folder.logs, ENVIRONMENT_LOG, 0)
                        words = log.read_text(errors="replace").splitlines()
                    raise StartError("; ".join([str(error), *words[-1:]])) from error
                finally:
                    await handle.kill()

    def _command(self, order: Order) -> list[str]:
        options = [
            *("--unshare-pid", "--unshare-ipc", "--unshare-uts", "--unshare-cgroup-try"),
            *(() if order.host_network else ("--unshare-net",)),
            *(() if self._root else ("--unshare-user",)),
            *("--as-pid-1", "--die-with-parent", "--new-session", "--cap-drop", "ALL"),
            *("--hostname", hostname(order.tag)),
            *_mounts(order),
            *("--chdir", "/"),
        ]
        return [self._bwrap, *options, "--", *HOLDER]


def _make_filter() -> tuple[bytes, str]:
    """Make the filter of system calls; return it, or a text about why it cannot be made."""
    try:
        return make_filter(), ""
    except FilterUnavailableError as error:
        return b"", f"system calls of containers are not filtered: {error}"


def interpreter_paths() -> list[Path]:
    """Return the machine's paths that the engine's Python needs inside."""
    wanted = [Path(sys.prefix), Path(sys.base_prefix), Path(sys.base_exec_prefix)]
    wanted.append(Path(sys.executable).resolve().parents[1])
    return [*wanted, *(path.resolve() for path in wanted), *_python_packages()]


@cache
def _compile() -> None:
    """Compile the modules here, once: inside they are read-only, and each container would do it again.

    In folders of another user nothing could be kept: all would be compiled in vain, at each start.
    """
    for folder in _python_packages():
        if os.access(folder, os.W_OK):
            compileall.compile_dir(folder, quiet=2)


def _python_packages() -> list[Path]:
    """Return the engine's packages and those with nodes; a checkout is outside the interpreter's folders."""
    root = source_root()
    return [root / "rce", root / "rce_container", *distributed_folders()]


def _mounts(order: Order) -> list[str]:
    """Return the mounts of the container's files; :mod:`rce_container.forkserver.mounts` mounts the rest."""
    folder = order.folder
    return [
        *system_mounts(),
        *("--proc", "/proc", "--dev", "/dev"),
        *(word for path in (*TEMPORARY, HOME) for word in ("--tmpfs", path)),
        *("--remount-ro", "/dev"),
        *("--ro-bind", str(folder.etc), "/etc"),
        *(word for name in _etc(order) for word in ("--ro-bind-try", f"/etc/{name}", f"/etc/{name}")),
        *("--bind", str(folder.logs), LOGS),
        *("--dir", "/opt", "--dir", "/opt/rce", "--ro-bind", str(folder.user_packages), BUNDLES),
        *read_only_mounts([*interpreter_paths(), *order.packages]),
        *("--dir", "/run", "--symlink", "../run", "/var/run"),
        *volume_mounts(order.volumes),
        *("--symlink", "../tmp", "/var/tmp", "--remount-ro", "/"),  # noqa: S108 - the container's own
    ]


def system_mounts() -> list[str]:
    """Return the mounts of the machine's programs and libraries."""
    options = ["--ro-bind", "/usr", "/usr"]
    for path in map(Path, _SYSTEM):
        if path.is_symlink():
            options += ["--symlink", str(path.readlink()), str(path)]
        elif path.is_dir():
            options += ["--ro-bind", str(path), str(path)]
    return [*options, "--ro-bind-try", "/opt/ros", "/opt/ros"]


def read_only_mounts(paths: Iterable[Path]) -> list[str]:
    """Bind paths at the same place, except those inside the system's folders."""
    options: list[str] = []
    for path in outermost(paths, Path("/usr")):
        for parent in reversed(path.parents[:-1]):
            options += ["--dir", str(parent)]  # by itself bubblewrap makes them for its own user only
        options += ["--ro-bind", str(path), str(path)]
    return options


def volume_mounts(volumes: Iterable[VolumeMount]) -> list[str]:
    """Bind the folders of volumes, and make the places where images are mounted."""
    options: list[str] = []
    for volume in volumes:
        for parent in reversed(Path(volume.path).parents[:-1]):
            options += ["--dir", str(parent)]
        bind = ["--dir", volume.path] if volume.image else ["--bind", str(volume.source), volume.path]
        options += bind
    return options


def check_volumes(order: Order) -> None:
    """Refuse volumes that would hide what the engine needs in a container.

    Raises:
        VolumeError: One would.
    """
    for volume in order.volumes:
        for path in (*interpreter_paths(), *order.packages):
            if overlap(volume.path, str(path)):
                raise VolumeError(
                    f"a volume at {volume.path} would hide {path}, which containers need on this machine; "
                    "use another path, such as /data"
                )


def _is_closed(folder: Path) -> bool:
    """Whether a folder exists that is not world-readable."""
    try:
        mode = folder.stat().st_mode
    except OSError:
        return False
    return mode & _READ_BY_OTHERS != _READ_BY_OTHERS


def outermost(paths: Iterable[Path], *bound: Path) -> list[Path]:
    """Leave out paths inside another one or inside a ``bound`` one, and paths that do not exist."""
    found: list[Path] = []
    for path in sorted({path.absolute() for path in paths}, key=lambda path: len(path.parts)):
        if path == Path("/") or any(map(path.is_relative_to, (*bound, *found))) or not path.exists():
            continue
        found.append(path)
    return found


def _etc(order: Order) -> tuple[str, ...]:
    """Return the machine's files in ``/etc``: with its network also its name servers."""
    return (*_ETC, "resolv.conf") if order.host_network else _ETC


def write_etc(order: Order) -> None:
    """Write the container's own ``/etc``, readable by its user. Its hosts may be known already."""
    etc, host = order.folder.etc, hostname(order.tag)
    etc.chmod(0o755)
    for name, text in (
        ("passwd", f"{USER}:x:{USER_ID}:{USER_ID}::{HOME}:/bin/sh\n"),
        ("group", f"{USER}:x:{USER_ID}:\n"),
        ("hosts", hosts_text(order.tag)),
        ("hostname", f"{host}\n"),
        ("nsswitch.conf", f"passwd: files\ngroup: files\nhosts: files{' dns' * order.host_network}\n"),
    ):
        (etc / name).write_text(text)
        (etc / name).chmod(0o644)
    for name in _etc(order):
        source = Path("/etc") / name
        if source.is_dir():
            (etc / name).mkdir(exist_ok=True)
        elif source.exists():
            (etc / name).touch()
