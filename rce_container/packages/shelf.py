"""A container's folder of packages: visible inside, read-only, from its start; filled while it runs."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from rce_container.environment.user_packages import REQUIREMENTS
from rce_container.packages.disk import replicate, scratch

KEPT = 8
"""How many packages stay that no node names any more: a running node may still read from them."""
_STAGING = "bundles.new"


class Shelf:
    """One container's packages. Each appears complete and vanishes as a whole, by one rename.

    Args:
        folder: The folder that the container sees; exists as long as the container.
        link: Whether its files may be hard links to the cache, because the container cannot write to it.
    """

    def __init__(self, folder: Path, *, link: bool) -> None:
        self._folder = folder
        self._link = link

    @property
    def is_there(self) -> bool:
        """Whether the container still exists."""
        return self._folder.is_dir()

    def has(self, sha256: str) -> bool:
        """Return whether it contains a package."""
        return (self._folder / sha256).is_dir()

    def place(self, sha256: str, tree: Path, requirements: Path | None) -> None:
        """Add a package. Blocks.

        Args:
            sha256: Its hash.
            tree: Its contents.
            requirements: Its installed requirements; None without requirements.

        Raises:
            OSError: It cannot be added; the container may just have ended.
        """
        if self.has(sha256):
            return
        if not self._folder.is_dir():
            raise FileNotFoundError(f"{self._folder} is gone")
        with scratch(self._folder.parent / _STAGING) as folder:
            made = folder / sha256
            replicate(tree, made, link=self._link)
            if requirements is not None:
                replicate(requirements, made / REQUIREMENTS, link=self._link)
            made.rename(self._folder / sha256)

    def tidy(self, wanted: Collection[str]) -> None:
        """Remove packages that no node names any more, except the newest few. Blocks."""
        left = [path for path in self._folder.iterdir() if path.name not in wanted]
        left.sort(key=lambda path: path.stat().st_mtime)
        for path in left[:-KEPT]:
            with scratch(self._folder.parent / _STAGING) as folder:
                path.rename(folder / path.name)
