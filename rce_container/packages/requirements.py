"""Installs what packages ask for in their ``requirements.txt``; only where the machine's operator allows it.

pip runs in a sandbox of bubblewrap, as user ``nobody``, with the network and, of the machine, only its
programs. It installs wheels only, so that no code of the installed packages runs. The result is kept under
the hash of the requirements and of the Python that they are for.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rce.guard import CrowdedError, Turns
from rce.packages.requirements import FILE_NAME, read_requirements
from rce.ros.errors import BadPackageError
from rce.ros.packages import MANIFESTS, parse_manifest
from rce_container.exceptions import RuntimeUnavailableError
from rce_container.files import remove, size_of
from rce_container.packages.disk import Locks, forget_before_boot, in_thread, scratch_aside
from rce_container.packages.exceptions import RequirementsTroubleError
from rce_container.runtimes.namespace import interpreter_paths, read_only_mounts, system_mounts

BUILD = "/build"
SITE = "site"
NOBODY = 65534

INSTALLS_AT_ONCE = 8
"""Concurrent installations, of different users; each runs pip, which mostly waits for the network."""
MAX_WAITING = 1024
_SCRATCH = "incoming"
_SYSTEM_PATH = "/usr/local/bin:/usr/bin:/bin"
_POLL_S = 1.0
_BLOCK = 512
_LAST_LINES = 5
_ETC = (
    *("resolv.conf", "hosts", "nsswitch.conf", "passwd", "group", "ssl", "ca-certificates", "pki"),
    *("ld.so.cache", "alternatives", "localtime", "python3", "pip.conf"),
)
_LIMIT = 'ulimit -f "$1" && shift && exec "$@"'


@dataclass(frozen=True, slots=True, kw_only=True)
class InstallerSettings:
    """How requirements are installed."""

    pip_args: tuple[str, ...] = ()
    """More arguments for ``pip install``, such as another index; the sandbox shows files that they name."""
    timeout: float = 600.0
    """Seconds."""
    size: int = 1 << 30
    """Bytes that one package's requirements may take."""
    space: int = 4 << 30
    """Bytes in total; beyond it, the least recently used are removed."""


class Installer:
    """The installed requirements of one machine.

    Args:
        folder: Belongs to this installer.
        settings: How requirements are installed.
        environ: Where pip's own settings and the proxies are read from.
    """

    def __init__(
        self, folder: Path, settings: InstallerSettings, environ: Mapping[str, str] = os.environ
    ) -> None:
        self._folder = folder
        self._settings = settings
        self._environ = {key: value for key, value in environ.items() if _is_for_pip(key)}
        self._turns = Turns(INSTALLS_AT_ONCE, waiting=MAX_WAITING, each=1)
        self._locks = Locks()
        self._tidying = asyncio.Lock()

    def open(self) -> None:
        """Find out whether it works here, and remove unfinished installations. Blocks.

        Raises:
            RuntimeUnavailableError: A program that it needs is missing.
            OSError: The folder cannot be used.
        """
        for program in ("bwrap", *(("setpriv",) if os.geteuid() == 0 else ())):
            if shutil.which(program) is None:
                raise RuntimeUnavailableError("requirements", f"{program} is not installed")
        forget_before_boot(self._folder)
        remove(self._folder / _SCRATCH)

    async def install(self, user: str, package: Path) -> Path:
        """Provide a package's requirements. Those of one user are installed one after the other.

        Args:
            user: Whose package it is.
            package: The package's folder.

        Returns:
            A folder with Python modules.

        Raises:
            RequirementsTroubleError: They cannot be installed.
            OSError: They cannot be written.
        """
        wanted = read_requirements((package / FILE_NAME).read_text("utf-8", "replace"))
        if wanted.faults:
            raise RequirementsTroubleError("; ".join(wanted.faults))
        python = await in_thread(_python_of, package)
        tag = await _tag_of(python)
        text = "\n".join(wanted.lines) + "\n"
        key = hashlib.sha256(f"{tag}\n{text}".encode()).hexdigest()
        path = self._folder / key
        try:
            await self._have(user, path, text, python)
        except CrowdedError:
            raise RequirementsTroubleError("too many requirements wait to be installed here") from None
        await in_thread(os.utime, path)
        async with self._tidying:
            await in_thread(self._make_room, path)
        return path

    async def _have(self, user: str, path: Path, text: str, python: str) -> None:
        """Build missing requirements; callers who wait for another one's build have no turn meanwhile."""
        while not await in_thread(path.is_dir):
            async with self._turns.turn(user):
                if path.name not in self._locks:
                    async with self._locks.of(path.name):
                        if not await in_thread(path.is_dir):
                            await self._build(path, text, python)
                    return
            async with self._locks.of(path.name):
                pass  # it is there now, or could not be built

    async def _build(self, path: Path, text: str, python: str) -> None:
        async with scratch_aside(self._folder / _SCRATCH) as folder:
            build = folder / "build"
            build.mkdir(mode=0o755)
            (build / FILE_NAME).write_text(text)
            if os.geteuid() == 0:
                os.chown(build, NOBODY, NOBODY)
            log = path.with_suffix(".log")
            try:
                code = await self._run_pip(build, log, python)
            except TimeoutError:
                raise RequirementsTroubleError(
                    f"its {FILE_NAME} was not installed within {self._settings.timeout:.0f} s"
                ) from None
            if code or not (build / SITE).is_dir():
                words = "; ".join(log.read_text(errors="replace").strip().splitlines()[-_LAST_LINES:])
                raise RequirementsTroubleError(f"pip could not install its {FILE_NAME}: {words}")
            await in_thread(_seal, build / SITE)
            (build / SITE).rename(path)

    async def _run_pip(self, build: Path, log: Path, python: str) -> int:
        blocks = str(self._settings.size // _BLOCK)
        argv = ["/bin/sh", "-c", _LIMIT, "rce-pip", blocks, *self._sandbox(build), *self._pip(python)]
        environ = {**self._environ, "PATH": _SYSTEM_PATH, "HOME": BUILD, "LANG": "C.UTF-8"}
        with log.open("wb") as output:
            process = await asyncio.create_subprocess_exec(
                *argv,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environ,
                start_new_session=True,
            )
        try:
            async with asyncio.timeout(self._settings.timeout):
                return await self._watch(process, build)
        finally:
            if process.returncode is None:
                process.kill()  # all processes of the sandbox end with it
                await process.wait()

    async def _watch(self, process: asyncio.subprocess.Process, build: Path) -> int:
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_POLL_S):
                    return await process.wait()
            if await in_thread(size_of, build) > self._settings.size:
                raise RequirementsTroubleError(
                    f"what its {FILE_NAME} asks for takes more than {self._settings.size} bytes"
                )

    def _pip(self, python: str) -> list[str]:
        other = () if python == sys.executable else ("--python", python)
        return [
            *(sys.executable, "-P", "-m", "pip", *other, "install", "--no-input", "--no-cache-dir"),
            *("--disable-pip-version-check", "--root-user-action", "ignore", "--only-binary", ":all:"),
            *("--target", f"{BUILD}/{SITE}", "--requirement", f"{BUILD}/{FILE_NAME}"),
            *self._settings.pip_args,
        ]

    def _sandbox(self, build: Path) -> list[str]:
        root = os.geteuid() == 0
        named = [*self._settings.pip_args, *self._environ.values()]
        seen = [path for word in named if (path := Path(word.partition("=")[2] or word)).is_absolute()]
        return [
            shutil.which("bwrap") or "bwrap",
            *("--unshare-pid", "--unshare-ipc", "--unshare-uts", "--unshare-cgroup-try"),
            *("--die-with-parent", "--new-session", "--cap-drop", "ALL"),
            *(("--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID") if root else ("--unshare-user",)),
            *system_mounts(),
            *("--proc", "/proc", "--dev", "/dev", "--tmpfs", "/tmp"),  # noqa: S108 - its own
            *(("--chmod", "1777", "/tmp") if root else ()),  # noqa: S108
            *("--dir", "/etc"),
            *(word for name in _ETC for word in ("--ro-bind-try", f"/etc/{name}", f"/etc/{name}")),
            *read_only_mounts([*interpreter_paths(), *seen]),
            *("--bind", str(build), BUILD, "--chdir", BUILD, "--"),
            *(_AS_NOBODY if root else ()),
        ]

    def _make_room(self, kept: Path) -> None:
        found = [path for path in self._folder.iterdir() if path.is_dir() and path.name != _SCRATCH]
        found.sort(key=lambda path: path.stat().st_mtime)
        sizes = {path: size_of(path) for path in found}
        for path in found:
            if sum(sizes.values()) > self._settings.space and path != kept:
                remove(path)
                path.with_suffix(".log").unlink(missing_ok=True)
                del sizes[path]


_AS_NOBODY = (
    "setpriv",
    *(f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--no-new-privs", "--inh-caps=-all"),
)


def _is_for_pip(variable: str) -> bool:
    known = ("SSL_CERT_FILE", "SSL_CERT_DIR", "REQUESTS_CA_BUNDLE")
    return variable.startswith("PIP_") or variable.lower().endswith("_proxy") or variable in known


def _python_of(package: Path) -> str:
    """The Python that a package's nodes run with."""
    for name in MANIFESTS:
        manifest = package / name
        if manifest.is_file():
            try:
                kind = parse_manifest(manifest, manifest.read_bytes(), package.name).python
            except BadPackageError as error:
                raise RequirementsTroubleError(str(error)) from error
            if kind == "engine":
                return sys.executable
            break
    found = shutil.which("python3", path=_SYSTEM_PATH)
    if found is None:
        raise RequirementsTroubleError("the machine has no python3 for it")
    return found


async def _tag_of(python: str) -> str:
    """Return the compatibility of a Python: its implementation, version and platform."""
    code = "import sys, sysconfig; print(sys.implementation.cache_tag, sysconfig.get_platform())"
    process = await asyncio.create_subprocess_exec(
        python, "-I", "-c", code, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE
    )
    try:
        output, _ = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    return output.decode().strip()


def _seal(site: Path) -> None:
    """Make all files world-readable, read-only, and owned by the engine's user."""
    own = os.geteuid(), os.getegid()
    for parent, _, files in os.walk(site):
        for path in (Path(parent), *(Path(parent, name) for name in files)):
            os.chown(path, *own, follow_symlinks=False)
            if not path.is_symlink():
                executable = path.is_dir() or path.stat().st_mode & 0o100
                path.chmod(0o755 if path.is_dir() else 0o555 if executable else 0o444)
