"""Gets into one container what its nodes need, and tells its owner what keeps it from coming."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from rce.aio.backoff import Backoff
from rce.bundles.requirements import FILE_NAME as REQUIREMENTS_FILE
from rce.control.model import BundleSpec
from rce.link.tasks import TaskScope
from rce_container.bundles.cache import BundleCache, trouble_of
from rce_container.bundles.disk import in_thread
from rce_container.bundles.exceptions import BundleTrouble
from rce_container.bundles.requirements import Installer
from rce_container.bundles.shelf import Shelf

log = logging.getLogger(__name__)

RETRY = Backoff(first=0.5, longest=30.0)
"""Pauses before it is tried again."""

_NOT_INSTALLED = (
    "it has a requirements.txt, which this machine does not install (its operator may allow it:"
    " rce-container --allow-requirements); its nodes start without"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Library:
    """Where all containers of a machine get packages from."""

    cache: BundleCache
    installer: Installer | None = None
    """Installs what packages ask for in their ``requirements.txt``; None: that is not allowed here."""
    retry: Backoff = RETRY

    def open(self) -> None:
        """Look at what is there. Blocks.

        Raises:
            OSError: The folders cannot be used.
        """
        self.cache.open()
        if self.installer is not None:
            self.installer.open()


class Supply:
    """The packages of one life of a container. Several come at once; one that fails holds up no other.

    Args:
        holder: Names this life.
        user: Whose container it is.
        library: Where packages come from.
        shelf: Where they go.
        tell: Takes a text for the owner.
        on_arrival: Called when something was put on the shelf.
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
        self._tasks = TaskScope()
        self._coming: dict[BundleSpec, asyncio.Task[None]] = {}
        self._closed = False

    def want(self, bundles: Iterable[BundleSpec]) -> None:
        """Get these, and no others."""
        wanted = set(bundles)
        if self._closed or wanted == self._coming.keys():
            return
        self._library.cache.hold(self._holder, {bundle.sha256 for bundle in wanted})
        for bundle in self._coming.keys() - wanted:
            self._coming.pop(bundle).cancel()
        for bundle in wanted - self._coming.keys():
            name = f"package {bundle.name} of {self._holder}"
            self._coming[bundle] = self._tasks.spawn(self._get(bundle), name)

    async def close(self) -> None:
        """Stop, and need nothing any more."""
        self._closed = True
        await self._tasks.close()
        self._library.cache.hold(self._holder, set())

    async def _get(self, bundle: BundleSpec) -> None:
        """Get one package, however often it takes."""
        told = ""
        pauses = self._library.retry.start()
        while True:
            try:
                await self._bring(bundle)
            except BundleTrouble as trouble:
                what = f"package {bundle.name} {bundle.version}"
                text = f"{what} is not there yet: {trouble}; it is tried again"
                if text != told:
                    log.warning("%s: %s", self._holder, text)
                    self._tell(text)
                told = text
                await asyncio.sleep(pauses.next() * trouble.patience)
            else:
                self._on_arrival()
                return

    async def _bring(self, bundle: BundleSpec) -> None:
        if self._shelf.has(bundle.sha256):
            return
        try:
            tree = await self._library.cache.ensure(self._user, bundle)
            requirements = await self._install(bundle, tree)
            await in_thread(self._shelf.place, bundle.sha256, tree, requirements)
            await in_thread(self._shelf.tidy, {one.sha256 for one in self._coming})
        except OSError as error:
            if self._shelf.is_there:
                raise trouble_of(error) from error

    async def _install(self, bundle: BundleSpec, tree: Path) -> Path | None:
        package = tree / bundle.name
        if not (package / REQUIREMENTS_FILE).is_file():
            return None
        if self._library.installer is None:
            self._tell(f"package {bundle.name} {bundle.version}: {_NOT_INSTALLED}")
            return None
        return await self._library.installer.install(self._user, package)
