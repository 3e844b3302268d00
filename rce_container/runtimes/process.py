"""The runtime without isolation: a container's processes are ordinary ones of this machine's user."""

from __future__ import annotations

from collections.abc import Sequence

from rce_container.environment.proc import MARK
from rce_container.folder import ContainerFolder
from rce_container.runtimes.base import ExecRuntime, Order, clean_environ

_ENV = "/usr/bin/env"


class ProcessRuntime(ExecRuntime):
    """No isolation: nodes see and may do all that the user of the container task set may."""

    name = "process"
    isolated = False

    def probe(self) -> None:
        """Works everywhere."""

    def paths(self, folder: ContainerFolder) -> tuple[str, str]:
        """The folders as they are."""
        return str(folder.home), str(folder.logs)

    def command(self, order: Order, argv: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        """Run it as it is, with a clean environment, and a mark by which its processes are found.

        The shim itself carries no mark: it is the one that looks for them.
        """
        return [_ENV, f"{MARK}={order.folder.incarnation_id}", *argv], clean_environ(str(order.folder.home))
