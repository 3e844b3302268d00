"""Files of log records, in the folders of a ROS installation: rotated; a failure to write never raises."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from logging.handlers import RotatingFileHandler
from pathlib import Path

_log = logging.getLogger(__name__)

LATEST = "latest"
"""Symbolic link to the folder of the newest run."""


def log_folder(environ: Mapping[str, str]) -> Path:
    """Return the folder for the logs of ROS programs.

    That is ``ROS_LOG_DIR``, or ``log`` in ``ROS_HOME``, or ``~/.ros/log``.
    """
    if folder := environ.get("ROS_LOG_DIR"):
        return Path(folder)
    home = environ.get("ROS_HOME")
    return (Path(home) if home else Path(environ.get("HOME") or Path.home(), ".ros")) / "log"


class LogFile(RotatingFileHandler):
    """A file that is rotated when it becomes large: ``x.log``, then ``x.log.1`` and so on, the oldest last.

    A failure, for instance because the disk is full, is reported once; unwritten records are lost.
    """

    def __init__(self, path: Path, form: str, *, max_bytes: int, backups: int) -> None:
        """Open a file, at its end if it is there.

        Args:
            path: Its folder is made if it is missing.
            form: How a record is written, as :class:`logging.Formatter` takes it.
            max_bytes: Length at which a new file begins.
            backups: How many older files are kept.

        Raises:
            OSError: It cannot be opened.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        super().__init__(path, maxBytes=max_bytes, backupCount=backups, encoding="utf-8", errors="replace")
        self.setFormatter(logging.Formatter(form))
        self._complained = False

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: ARG002, N802
        """Report that a record was not written, the first time only."""
        if not self._complained:
            self._complained = True
            _log.warning("%s: records are lost", self.baseFilename, exc_info=True)


def mark_latest(folder: Path) -> None:
    """Make ``latest`` beside a run's folder point at it, as ``roslaunch`` does; a file of that name stays."""
    link = folder.with_name(LATEST)
    try:
        if link.is_symlink():
            link.unlink()
        if not link.exists():
            link.symlink_to(folder)
    except OSError as error:
        _log.info("%s does not point at this run: %s", link, error)
