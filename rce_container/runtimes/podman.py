"""The runtime of images: podman makes the namespaces over an image's files, the nursery's children live in them.

It is the ``namespace`` runtime with another root: the holder is a shell of the image, started by podman, and
the environment joins it from outside and confines itself as everywhere. So an image needs no Python of its own.

Podman, its monitor and the holder share a pid namespace of their own, whose process 1 is podman: they die
together. All that podman notes of the container is in a tmpfs of a mount namespace of their own: it is gone with
them, and the machine's own ``podman ps`` and mounts never show it. Images are read from the machine's store.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from rce_container.exceptions import RuntimeUnavailableError, StartError
from rce_container.network.hosts import hostname
from rce_container.nursery.mounts import HOME, LOGS, TEMPORARY
from rce_container.runtimes.base import Order
from rce_container.runtimes.held import HOLDER, HeldHandle
from rce_container.runtimes.namespace import NamespaceRuntime, interpreter_paths, outermost, write_etc

_NAME = re.compile(r"[a-z0-9][\w.:-]*(/[\w.-]+)*(:[\w.-]+)?(@sha256:[0-9a-f]{64})?", re.ASCII | re.IGNORECASE)
_TIMEOUT_S = 20.0
_OWN_FILES = ("passwd", "group", "hosts")
_MACHINE = ("/usr", "/bin", "/lib", "/lib64")

# Podman's own state is in memory. crun refuses machines that have controllers in both kinds of cgroups, though
# it is to leave cgroups alone: the newer kind is hidden from it.
_SCRIPT = """
mount -t tmpfs -o mode=700 tmpfs "$1" && cd "$1" || exit 1
[ ! -d /sys/fs/cgroup/unified ] || mount -t tmpfs tmpfs /sys/fs/cgroup/unified
export HOME="$1" TMPDIR="$1" XDG_RUNTIME_DIR="$1" CONTAINERS_CONF="$1/conf"
printf '[engine]\\nlock_type = "file"\\n' >conf
shift
exec "$@" 3<&0 0</dev/null 1>&2
"""
_TETHER = "exec <&3 >&3 3<&-"
"""Podman passes the tether on as descriptor 3; the holder wants it as its standard input and output."""


class PodmanRuntime(NamespaceRuntime):
    """Isolation as by :class:`NamespaceRuntime`, in an image or a folder with a root file system. Needs root.

    Args:
        images: What this machine offers beside the images in podman's store: folders. The first one, image or
            folder, is that of containers which name none.
        options: As for :class:`NamespaceRuntime`.
    """

    name = "podman"

    def __init__(self, images: Sequence[str] = (), **options: Any) -> None:
        super().__init__(**options)
        self._images = tuple(images)
        self._podman = shutil.which("podman") or ""
        self._store: tuple[str, str] = ("", "")

    def check_tools(self) -> None:
        """Look for podman and its store of images."""
        if not self._root:
            raise RuntimeUnavailableError(self.name, "it needs root")
        if not self._podman:
            raise RuntimeUnavailableError(
                self.name, "podman is not installed (Debian, Ubuntu: apt install podman crun)"
            )
        if not shutil.which("unshare"):
            raise RuntimeUnavailableError(self.name, "unshare is not installed (Debian: apt install util-linux)")
