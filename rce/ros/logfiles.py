"""Files of log records, where a ROS installation has them: rotated, and never a reason to fail."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from logging.handlers import RotatingFileHandler
from pathlib import Path

_log = logging.getLogger(__name__)

LATEST = "latest"
"""Symbolic link to the folder of the newest run."""


def log_folder(environ: Mapping[str, str]) -> Path:
    """Return where programs of ROS put their logs.

    That is ``ROS_LOG_DIR``, or ``log`` in ``ROS_HOME``, or ``~/.ros/log``.
    """
    if folder := environ.get("ROS_LOG_DIR"):
        return Path(folder)
    home = environ.get("ROS_HOME")
    return (Path(home) if home else Path(environ.get("HOME") or Path.home(), ".ros")) / "log"


class LogFile(RotatingFileHandler):
    """A file that is cut when it becomes large: ``x.log``, then ``x.log.1`` and so on, the oldest last.

    A disk that is full, for instance, is told of once; what cannot be written is lost then.
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
        """Tell that a record was not written, the first time."""
        if not self._complained:
            self._complained = True
            _log.warning("%s: records are lost", self.baseFilename, exc_info=True)


def mark_latest(folder: Path) -> None:
    """Let ``latest`` beside a run's folder point at it, as ``roslaunch`` does; a file of that name stays."""
    link = folder.with_name(LATEST)
    try:
        if link.is_symlink():
            link.unlink()
        if not link.exists():
            link.symlink_to(folder)
    except OSError as error:
        _log.info("%s does not point at this run: %s", link, error)
