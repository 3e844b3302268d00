"""Supplies one container with the packages of its nodes, and reports problems to its owner."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from rce.aio.backoff import Backoff
from rce.aio.tasks import BackgroundTasks
from rce.control import PackageSpec
from rce.packages.requirements import FILE_NAME as REQUIREMENTS_FILE
from rce_container.packages.cache import PackageCache, trouble_of
from rce_container.packages.disk import in_thread
from rce_container.packages.exceptions import PackageTroubleError
from rce_container.packages.requirements import Installer
from rce_container.packages.shelf import Shelf

_log = logging.getLogger(__name__)

RETRY = Backoff(first=0.5, longest=30.0)
"""Delays before another attempt."""

_FAULT = "a fault on the container's machine, which its log describes; tell its operator"
_NOT_INSTALLED = (
    "it has a requirements.txt, which this machine does not install (its operator may allow it:"
    " rce-container --allow-requirements); its nodes start without"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Library:
    """The source of packages for all containers of a machine."""

    cache: PackageCache
    installer: Installer | None = None
    """Installs what packages ask for in their ``requirements.txt``; None: not allowed here."""
    retry: Backoff = RETRY

    def open(self) -> None:
        """Find the kept packages. Blocks.

        Raises:
            OSError: The folders cannot be used.
        """
        self.cache.open()
        if self.installer is not None:
            self.installer.open()


class Supply:
    """The packages of one incarnation of a container. Several are fetched at once; a failure delays no other.

    Args:
        holder: The id of this incarnation.
        user: The container's user.
        library: The source of packages.
        shelf: The container's folder of packages.
        tell: Takes a text for the owner.
        on_arrival: Called when a package was added to the shelf.
    """

    def __init__(
        self,
        holder: str,
        user: str,
        library: Library,
        shelf: Shelf,
        *,
        tell: Callable[[str], None],
        on_arrival: Callable[[], None],
    ) -> None:
        self._holder = holder
        self._user = user
        self._library = library
        self._shelf = shelf
        self._tell = tell
        self._on_arrival = on_arrival
        self._tasks = BackgroundTasks()
        self._coming: dict[PackageSpec, asyncio.Task[None]] = {}
        self._shelf_lock = asyncio.Lock()
        """Held while the shelf is looked at or changed: a package being removed must not count as there."""
        self._closed = False

    def want(self, packages: Iterable[PackageSpec]) -> None:
        """Supply exactly these packages."""
        wanted = set(packages)
        if self._closed or wanted == self._coming.keys():
            return
        self._library.cache.hold(self._holder, {package.sha256 for package in wanted})
        for package in self._coming.keys() - wanted:
            self._coming.pop(package).cancel()
        for package in wanted - self._coming.keys():
            name = f"package {package.name} of {self._holder}"
            self._coming[package] = self._tasks.spawn(self._get(package), name=name)

    async def close(self) -> None:
        """Stop, and release all packages."""
        self._closed = True
        await self._tasks.close()
        self._library.cache.hold(self._holder, set())

    async def _get(self, package: PackageSpec) -> None:
        """Get one package; retry until it succeeds."""
        told = ""
        pauses = self._library.retry.start()
        while True:
            try:
                await self._bring(package)
            except PackageTroubleError as trouble:
                told = self._report(package, str(trouble), told)
                delay_factor = trouble.delay_factor
            except Exception as error:  # noqa: BLE001 - the nodes wait for their package, whatever the fault
                told = self._report(package, _FAULT, told, error)
                delay_factor = PackageTroubleError.delay_factor
            else:
                self._on_arrival()
                return
            await asyncio.sleep(pauses.next() * delay_factor)

    def _report(self, package: PackageSpec, trouble: str, told: str, fault: Exception | None = None) -> str:
        """Report a problem, unless it is the one that was told last; return what was told."""
        text = f"package {package.name} {package.version} is not there yet: {trouble}; it is tried again"
        if text != told:
            _log.warning("%s: %s", self._holder, text, exc_info=fault)
            self._tell(text)
        return text

    async def _bring(self, package: PackageSpec) -> None:
        async with self._shelf_lock:
            if self._shelf.has(package.sha256):
                return
        try:
            tree = await self._library.cache.ensure(self._user, package)
            requirements = await self._install(package, tree)
            async with self._shelf_lock:
                await in_thread(self._shelf.place, package.sha256, tree, requirements)
                await in_thread(self._shelf.tidy, {one.sha256 for one in self._coming})
        except OSError as error:
            if self._shelf.is_there:
                raise trouble_of(error) from error

    async def _install(self, package: PackageSpec, tree: Path) -> Path | None:
        folder = tree / package.name
        if not (folder / REQUIREMENTS_FILE).is_file():
            return None
        if self._library.installer is None:
            self._tell(f"package {package.name} {package.version}: {_NOT_INSTALLED}")
            return None
        return await self._library.installer.install(self._user, folder)
