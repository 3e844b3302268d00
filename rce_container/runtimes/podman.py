"""The runtime of images: podman makes the namespaces, the fork server's children run in them.

It is the ``namespace`` runtime with another root. The holder is a shell of the image, started by podman; the
environment joins it from outside and confines itself as in the ``namespace`` runtime, so an image does not
need its own Python.

Podman, its monitor and the holder share a separate pid namespace whose process 1 is podman, so they end
together. Podman's records of the container are in memory, in their mount namespace, and end with them;
neither the machine's mounts nor its own ``podman ps`` show them. Images are read in place.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

from rce_container.exceptions import RuntimeUnavailableError, StartError
from rce_container.folder import ContainerFolder
from rce_container.forkserver.mounts import HOME, LOGS
from rce_container.network.addresses import hostname
from rce_container.runtimes.base import Order
from rce_container.runtimes.held import HOLDER, HeldHandle
from rce_container.runtimes.namespace import (
    BUNDLES,
    HOME_BYTES,
    NamespaceRuntime,
    interpreter_paths,
    outermost,
)
from rce_container.runtimes.shim import SHELL
from rce_container.uids import UidPool
from rce_container.volumes.store import VolumeMount

_IMAGE = re.compile(
    r"[a-z0-9][\w.-]*(:[0-9]+)?(/[\w.-]+)*(:[\w.-]+)?(@sha256:[0-9a-f]{64})?", re.ASCII | re.IGNORECASE
)
_TRANSPORTS = (
    *("containers-storage", "dir", "docker-archive", "docker-daemon", "oci", "oci-archive"),
    *("ostree", "sif", "tarball"),
)
STATE = Path("/run/rce/podman")
"""Where podman keeps its state; each running podman sees its own state there."""
_TIMEOUT_S = 60.0
"""How long podman may take to say what it is, seconds: a busy machine must not look like one without it."""
_DRIVER = "overlay"

# Podman's own state is in memory, its locks in files, because those in memory are the whole machine's. crun
# refuses machines that have controllers in cgroups of both versions, although it is not to use cgroups: the
# newer version is hidden from it.
_SCRIPT = """
mount -t tmpfs -o mode=700 tmpfs "$1" && cd "$1" || exit 1
[ ! -d /sys/fs/cgroup/unified ] || mount -t tmpfs tmpfs /sys/fs/cgroup/unified
export HOME="$1" TMPDIR="$1" XDG_RUNTIME_DIR="$1" CONTAINERS_CONF="$1/conf"
printf '[engine]\\nlock_type = "file"\\n' >conf
shift
exec "$@" 3<&0 0</dev/null 1>&2
"""
_HOLDER = f"exec <&3 >&3 3<&-; {HOLDER[-1]}"
"""Podman passes the lifeline on as descriptor 3; the holder needs it as standard input and output."""

_APART = ("--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "--propagation", "private")
_MACHINE = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32")
_OF_THE_IMAGE = ("/usr", "/opt/ros")
_OWN_ETC = ("passwd", "group", "hosts")
_TEMPORARY = ("/tmp:mode=1777", f"{HOME}:mode=755")  # noqa: S108 - the container's own
_FIXED = (
    *("--pull=never", "--entrypoint", SHELL, "--workdir=/", "--user=0:0", "--preserve-fds=1"),
    *("--cgroups=disabled", "--cgroupns=private", "--ipc=private", "--read-only", "--read-only-tmpfs=false"),
    *("--cap-drop=all", "--security-opt=no-new-privileges"),
    *("--ulimit=nofile=1024:1024", "--ulimit=nproc=1024:1024"),  # podman's own may be above what is allowed
    *("--no-hosts", "--passwd=false", "--unsetenv-all", "--http-proxy=false", "--image-volume=ignore"),
    *("--systemd=false", "--sdnotify=ignore", "--log-driver=none"),
)


class PodmanRuntime(NamespaceRuntime):
    """Isolation as in :class:`NamespaceRuntime`, within an image or a folder. Needs root.

    Args:
        images: The folders with a root file system that containers may ask for, beside the images of
            podman's store. The first one, folder or image, is that of containers which ask for none; without
            any, those have the machine's programs.
        home_bytes: Size of a container's home.
        uids: The users for containers; None takes the default ones.
        packages: The machine's folders of packages, which are searched once for all containers.
    """

    name = "podman"

    def __init__(
        self,
        images: Sequence[str] = (),
        *,
        home_bytes: int = HOME_BYTES,
        uids: UidPool | None = None,
        packages: Iterable[Path] = (),
    ) -> None:
        super().__init__(home_bytes=home_bytes, uids=uids, packages=packages)
        self.image = images[0] if images else ""
        self._images = tuple(images)
        self._podman = shutil.which("podman") or ""
        self._unshare = shutil.which("unshare") or ""
        self._store = ""

    @property
    def is_installed(self) -> bool:
        """Whether podman is installed, even if it does not work."""
        return bool(self._podman)

    def require(self) -> None:
        """Look for podman and its images."""
        reason = ""
        if not self._podman:
            reason = "podman is not installed (Debian, Ubuntu: apt install podman crun)"
        elif not self._root:
            reason = "it needs root"
        elif not self._unshare:
            reason = "unshare is not installed (Debian, Ubuntu: apt install util-linux)"
        if reason:
            raise RuntimeUnavailableError(self.name, reason)
        driver, self._store = self._find_store()
        if driver != _DRIVER:
            raise RuntimeUnavailableError(
                self.name,
                f"podman's images are in a store of the kind {driver!r}; set driver = {_DRIVER!r} in "
                "/etc/containers/storage.conf",
            )

    def _find_store(self) -> tuple[str, str]:
        form = "{{.Store.GraphDriverName}} {{.Store.GraphRoot}}"
        try:
            with tempfile.TemporaryDirectory() as scratch:  # crun makes a folder here, even to be asked
                found = subprocess.run(  # noqa: S603
                    [self._podman, "info", "--format", form],
                    stdin=subprocess.DEVNULL,
                    capture_output=True,
                    text=True,
                    timeout=_TIMEOUT_S,
                    check=True,
                    env={**os.environ, "XDG_RUNTIME_DIR": scratch},
                )
        except subprocess.CalledProcessError as error:
            raise RuntimeUnavailableError(self.name, error.stderr.strip() or str(error)) from error
        except (OSError, subprocess.TimeoutExpired) as error:
            raise RuntimeUnavailableError(self.name, str(error)) from error
        driver, _, root = found.stdout.strip().partition(" ")
        return driver, root

    def start(self, order: Order) -> HeldHandle:
        """Make the container's namespaces; the environment comes to life by the handle's ``launch``."""
        handle = super().start(order)
        if order.image:
            handle.failure = (
                f"podman cannot start the image {order.image} (if it is not there, the machine's operator "
                "can fetch it: podman pull)"
            )
        return handle

    def _command(self, order: Order) -> list[str]:
        STATE.mkdir(mode=0o700, parents=True, exist_ok=True)
        podman = {
            "--root": f"{STATE}/root",
            "--runroot": f"{STATE}/run",
            "--tmpdir": f"{STATE}/events",
            "--runtime-flag": f"root={STATE}/crun",
            "--cgroup-manager": "cgroupfs",
            "--events-backend": "none",
            "--storage-driver": _DRIVER,
            "--storage-opt": f"additionalimagestore={self._store}",
        }
        run = {
            "--name": order.folder.incarnation_id,
            "--hostname": hostname(order.tag),
            "--network": "host" if order.host_network else "none",
        }
        return [
            *(self._unshare, *_APART, SHELL, "-c", _SCRIPT, "rce-podman", str(STATE)),
            *(self._podman, *chain.from_iterable(podman.items())),
            *("run", *_FIXED, *chain.from_iterable(run.items())),
            *(f"--tmpfs={one},notmpcopyup" for one in _TEMPORARY),
            *self._root_of(order),
            *("-c", _HOLDER),
        ]

    def _root_of(self, order: Order) -> list[str]:
        """The options that say what is mounted, and the image at their end.

        Raises:
            StartError: The image does not exist, or is not for containers.
        """
        folder = order.folder
        mounts = [(path, str(path)) for path in outermost(_paths(order))]
        mounts += [(folder.etc / name, f"/etc/{name}") for name in _OWN_ETC]
        mounts.append((folder.user_packages, BUNDLES))
        image = order.image
        if not image:
            root = folder.path / "root"
            root.mkdir(mode=0o755, exist_ok=True)
            mounts += [(Path(path), path) for path in _MACHINE if Path(path).is_dir()]
            last = ["--rootfs", f"{root}:O"]
        elif image.startswith("/"):
            if image not in self._images:
                raise StartError(
                    f"the folder {image} is not offered to containers; this machine's operator may offer it: "
                    f"rce-container --image {image}"
                )
            last = ["--rootfs", f"{image}:O"]
        elif is_image_name(image):
            last = [image]
        else:
            raise StartError(f"{image!r} is neither the name of an image nor the path of a folder")
        options = [f"--volume={source}:{target}:ro" for source, target in mounts]
        options += [f"--volume={_point(folder, one)}:{one.path}:rw" for one in order.volumes]
        return [*options, f"--volume={folder.logs}:{LOGS}:rw", *last]


def _point(folder: ContainerFolder, volume: VolumeMount) -> Path:
    """Return what podman mounts at the path of a volume: its folder, or a place to mount its image."""
    if not volume.image:
        return volume.source
    point = folder.path / "volumes" / volume.variable
    point.mkdir(mode=0o700, parents=True, exist_ok=True)
    return point


def is_image_name(text: str) -> bool:
    """Whether podman reads this as an image's name, and not as an option or a location of an image."""
    return bool(_IMAGE.fullmatch(text)) and text.partition(":")[0] not in _TRANSPORTS


def _paths(order: Order) -> list[Path]:
    """Return the paths that are the same inside and outside, except those of the image."""
    packages = [path for path in order.packages if not any(map(path.is_relative_to, _OF_THE_IMAGE))]
    return [*_engine_paths(), *packages]


def _engine_paths() -> list[Path]:
    """Return the paths of the engine and its Python; of a system Python, only its own files."""
    found: list[Path] = []
    python = f"python{sys.version_info.major}.{sys.version_info.minor}"
    for path in interpreter_paths():
        if path in (Path("/usr"), Path("/usr/local")):
            found += [path / "bin" / python, path / "lib" / python, *path.glob(f"lib/lib{python}*")]
        else:
            found.append(path)
    return found
