"""Which contents the snapshots of volumes need: their manifests, and what these name."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import TYPE_CHECKING

from rce.control import SnapshotError
from rce.control.snapshots import decode_manifest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_master.packages.contents import ContentStore
    from rce_master.state.table import Table
    from rce_master.state.volume_records import UserVolume


class NeededSnapshots:
    """The contents of all volumes' snapshots, as far as this master has read their manifests.

    Args:
        volumes: All volumes.
        store: Has the manifests.
    """

    def __init__(self, volumes: Table[UserVolume], store: ContentStore) -> None:
        self._volumes = volumes
        self._store = store
        self._named: dict[str, frozenset[str]] = {}
        """The contents that each manifest names."""
        self._uses: Counter[str] = Counter()
        """How many of these manifests name a content."""

    async def look(self) -> None:
        """Read the manifests of new snapshots, and forget those that no volume needs any more."""
        snapshots = self._snapshots()
        for sha256 in self._named.keys() - snapshots:
            self._forget(sha256)
            await asyncio.sleep(0)
        for sha256 in snapshots - self._named.keys():
            with contextlib.suppress(OSError, SnapshotError):  # another master may still have it
                self.add(sha256, await asyncio.to_thread(self._read, sha256))

    def add(self, snapshot: str, contents: Iterable[str]) -> None:
        """Note what a manifest names.

        Args:
            snapshot: The hash of the manifest.
            contents: The hashes of the contents.
        """
        if snapshot not in self._named:
            self._named[snapshot] = frozenset(contents)
            self._uses.update(self._named[snapshot])

    def hashes(self) -> set[str]:
        """Return the hashes of all contents."""
        return self._snapshots() | self._uses.keys()

    def contents_of(self, snapshot: str) -> frozenset[str]:
        """Return the hashes of a snapshot's manifest, and of what this names if it was read."""
        return self._named.get(snapshot, frozenset()) | {snapshot}

    def is_needed(self, sha256: str) -> bool:
        """Tell whether a content is needed."""
        return sha256 in self._uses or bool(self._volumes.count("snapshot", sha256))

    def is_complete(self) -> bool:
        """Tell whether all manifests were read; else it is not known which contents are needed."""
        return all(known.snapshot in self._named for known in self._volumes if known.snapshot)

    def _snapshots(self) -> set[str]:
        return {known.snapshot for known in self._volumes if known.snapshot}

    def _read(self, sha256: str) -> frozenset[str]:
        return frozenset(decode_manifest(self._store.path(sha256).read_bytes()).contents)

    def _forget(self, sha256: str) -> None:
        for content in self._named.pop(sha256, ()):
            self._uses[content] -= 1
            if not self._uses[content]:
                del self._uses[content]
