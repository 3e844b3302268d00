"""A package that a user pushes to one of several masters, and which of them hold its archive."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from support.engine import until
from support.masters import DEV_USER
from support.user_packages import pack, sign, write_package

if TYPE_CHECKING:
    from pathlib import Path

    from support.masters import MasterProcess, Masters

WAIT_S = 120.0
NODE = "import time\nprint('{text}', flush=True)\ntime.sleep(3600)\n"


class Pushed:
    """A package as the user has it."""

    def __init__(self, folder: Path, name: str) -> None:
        self.name = name
        self.archive = pack(write_package(folder, name, nodes__run=NODE.format(text=name)))
        self.sha256 = hashlib.sha256(self.archive).hexdigest()
        self.spec = sign(self.archive, name, "1.0", DEV_USER)

    async def push(self, made: Masters, at: MasterProcess, status: int = 200) -> str:
        """Push it to a master."""
        url = f"{at.url}api/v1/packages/{self.name}/1.0"
        query = {"key": self.spec.key, "signature": self.spec.signature}
        got, text = await made.ask("PUT", url, params=query, data=self.archive)
        assert got == status, text
        return text

    def path(self, master: MasterProcess) -> Path:
        return master.log.parent / master.name / "bundles" / self.sha256

    def holders(self, made: Masters) -> list[MasterProcess]:
        return [master for master in made.all if self._is_at(master)]

    def _is_at(self, master: MasterProcess) -> bool:
        try:
            archive = self.path(master).read_bytes()
        except FileNotFoundError:
            return False
        assert archive == self.archive
        return True

    async def until_held(self, made: Masters, count: int) -> None:
        await until(lambda: len(self.holders(made)) == count, timeout=WAIT_S, what=f"{count} have it")
