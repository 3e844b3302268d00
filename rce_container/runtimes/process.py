"""The runtime without isolation: a container's processes are ordinary ones of this machine's user."""

from __future__ import annotations

from collections.abc import Sequence

from rce_container.environment.proc import MARK
from rce_container.folder import ContainerFolder
from rce_container.runtimes.base import ExecRuntime, Order, clean_environ

_ENV = "/usr/bin/env"


class ProcessRuntime(ExecRuntime):
    """No isolation: nodes have all permissions of the user of the container task set."""

    name = "process"
    isolated = False

    def probe(self) -> None:
        """Do nothing: this runtime works on every machine."""

    def paths(self, folder: ContainerFolder) -> tuple[str, str]:
        """Return the folders unchanged."""
        return str(folder.home), str(folder.logs)

    def command(self, order: Order, argv: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        """Return the command unchanged, with a clean environment and a mark that identifies its processes.

        The shim itself does not carry the mark: it searches for it.
        """
        variables = {volume.variable: str(volume.source) for volume in order.volumes}
        environ = {**clean_environ(str(order.folder.home)), **variables}
        return [_ENV, f"{MARK}={order.folder.incarnation_id}", *argv], environ
