"""A command that runs when this process has ended, however it ended: also by SIGKILL."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
from collections.abc import Sequence
from typing import Self

_DISARM = b"done\n"
_SHELL = 'trap "" HUP INT TERM; read -r word; [ "$word" = done ] || exec "$@"'
"""Reads a pipe of which this process has the only other end. It costs half a megabyte while it waits."""


class FinalCommand:
    """Waits in a separate process for the end of this one, then runs a command.

    Signals for this process, from a terminal or at its end, do not reach the other one. asyncio does not own
    it either, because that kills its child processes when an interrupted program is torn down.

    Example:
        >>> final = await FinalCommand.arm(["rm", "-rf", folder])
        >>> await final.disarm()
    """

    def __init__(self, argv: Sequence[str], process: subprocess.Popen[bytes]) -> None:
        self._argv = argv
        self._process = process

    @classmethod
    async def arm(cls, argv: Sequence[str]) -> Self:
        """Arrange that ``argv`` runs as soon as this process has ended, with the same output streams.

        Raises:
            OSError: No shell can be started.
        """
        process = await asyncio.to_thread(
            subprocess.Popen,
            ("sh", "-c", _SHELL, "sh", *argv),
            bufsize=0,
            stdin=subprocess.PIPE,
            start_new_session=True,
        )
        return cls(argv, process)

    async def run(self) -> int:
        """Run the command now, once more if it or its waiting process was killed; return its exit code.

        Raises:
            OSError: It was killed, and no other shell can be started.
        """
        code = await self._close()
        if code >= 0:
            return code
        again = await self.arm(self._argv)
        return await again._close()  # noqa: SLF001 - of the same class

    async def disarm(self) -> None:
        """Cancel the command."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # its process was killed
            self._process.stdin.write(_DISARM)
        await self._close()

    async def _close(self) -> int:
        assert self._process.stdin is not None
        self._process.stdin.close()
        return await asyncio.to_thread(self._process.wait)
