"""The settings of a container task set. Times in seconds."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from rce.model import MEGABYTE
from rce_container.archive import LOG_DAYS, LOG_SPACE
from rce_container.packages.requirements import InstallerSettings
from rce_container.uids import FIRST_UID, UIDS

BUNDLE_SPACE = 4096 * MEGABYTE


@dataclass(frozen=True, slots=True, kw_only=True)
class ContainerSettings:
    """The settings of a manager and its containers."""

    machine: str
    """See :class:`rce.control.model.LinkAddress`."""
    packages: tuple[Path, ...] = ()
    """Folders with packages, the more important first; containers see them read-only."""
    labels: tuple[str, ...] = ()
    """Special features of this machine, which containers may request."""
    grace: float = 30.0
    """Seconds without a manager after which a container ends itself."""
    interrupt_timeout: float = 15.0
    """Seconds that a node has to end after SIGINT, before it gets SIGTERM."""
    terminate_timeout: float = 2.0
    """Seconds that a node has to end after SIGTERM, before it gets SIGKILL."""
    starts_at_once: int = 2 * (os.cpu_count() or 1)
    """How many environments are started at the same time; more would only compete for the processors."""
    start_timeout: float = 30.0
    """Seconds after its start within which an environment has to report; else it is killed."""
    adopt_timeout: float = 3.0
    """Seconds within which a container of an earlier manager has to answer; else it is killed."""
    cleanup_timeout: float = 10.0
    """Seconds that a container has to end, in addition to its nodes' times, before it is killed."""
    usage_interval: float = 2.0
    log_days: float = LOG_DAYS
    """How long the logs of a container are kept after its end."""
    log_space: int = LOG_SPACE
    """How many bytes the logs of containers that ended may take in all; the oldest go first."""
    prune_interval: float = 60.0
    """Interval of the search for logs to remove."""
    bundle_space: int = BUNDLE_SPACE
    """How many bytes of packages that users brought are kept, unless more are in use."""
    requirements: InstallerSettings | None = None
    """How the ``requirements.txt`` of these packages are installed; None: not at all."""
    tls: bool = False
    """Whether links by TCP must be in TLS."""
    images: tuple[str, ...] = ()
    """See :class:`rce_container.runtimes.podman.PodmanRuntime`."""
    offer_images: bool = True
    """Whether containers may have an image, whatever the runtime of the others is."""
    home_bytes: int = 256 * MEGABYTE
    """Size of a container's home, which is in memory."""
    first_uid: int = FIRST_UID
    """As root each container runs as a separate user, from this one on; they must not be used otherwise."""
    uids: int = UIDS
    """The number of such users."""
    slots: int = 0
    """Slots of this machine; 0: according to its memory."""
    slot_memory: int = 512 * MEGABYTE
    """Memory of a container for each of its slots (bytes), unless it asks for another amount."""
    slot_processes: int = 256
    """Processes and threads of a container for each of its slots."""

    @property
    def stop_timeout(self) -> float:
        """How long a container may take to stop."""
        return self.interrupt_timeout + self.terminate_timeout + self.cleanup_timeout
