"""What can be set of a container task set. Times in seconds."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from rce.control.machine import MEGABYTE
from rce_container.archive import LOG_DAYS, LOG_SPACE
from rce_container.packages.requirements import InstallerSettings
from rce_container.uids import FIRST_UID, UIDS

BUNDLE_SPACE = 4096 * MEGABYTE


@dataclass(frozen=True, slots=True, kw_only=True)
class ContainerSettings:
    """How a manager and its containers are run."""

    machine: str
    """See :class:`rce.control.model.LinkAddress`."""
    packages: tuple[Path, ...] = ()
    """Folders with packages, the more important first; containers see them read-only."""
    labels: tuple[str, ...] = ()
    """What this machine has; containers ask for it as special features."""
    grace: float = 30.0
    """A container without a manager ends itself after so long."""
    interrupt_timeout: float = 15.0
    """A node has so long to end after SIGINT, before it gets SIGTERM."""
    terminate_timeout: float = 2.0
    """A node has so long to end after SIGTERM, before it gets SIGKILL."""
    starts_at_once: int = 2 * (os.cpu_count() or 1)
    """So many environments are started side by side; more would only take the processors from each other, and
    from the engine and the containers that run."""
    start_timeout: float = 30.0
    """An environment that did not report for so long after its start is killed."""
    adopt_timeout: float = 3.0
    """A container of an earlier manager that does not answer within this time is killed."""
    cleanup_timeout: float = 10.0
    """What a container has on top of its nodes' times to end by itself, before it is killed."""
    usage_interval: float = 2.0
    log_days: float = LOG_DAYS
    """How long the logs of a container are kept after its end."""
    log_space: int = LOG_SPACE
    """How many bytes the logs of containers that ended may take in all; the oldest go first."""
    prune_interval: float = 60.0
    """How often is looked for logs to remove."""
    bundle_space: int = BUNDLE_SPACE
    """How many bytes of packages that users brought are kept, unless more are in use."""
    requirements: InstallerSettings | None = None
    """How what these packages ask for in a ``requirements.txt`` is installed; None: it is not."""
    tls: bool = False
    """Whether links by TCP must be in TLS."""
    images: tuple[str, ...] = ()
    """See :class:`rce_container.runtimes.podman.PodmanRuntime`."""
    home_bytes: int = 256 * MEGABYTE
    """Size of a container's home, which lives in memory."""
    first_uid: int = FIRST_UID
    """As root each container runs as a user of its own, from this one on; no other user may have them."""
    uids: int = UIDS
    """How many such users there are."""
    slots: int = 0
    """What this machine offers in all; 0: as many as its memory says."""
    slot_memory: int = 512 * MEGABYTE
    """Memory of a container for each of its slots (bytes), unless it asks for another amount."""
    slot_processes: int = 256
    """Processes and threads of a container for each of its slots."""

    @property
    def stop_timeout(self) -> float:
        """How long a container may take to stop."""
        return self.interrupt_timeout + self.terminate_timeout + self.cleanup_timeout
