"""What can go wrong when a conversion is left to another process.

::

    RobotError
    +-- ConversionFailedError  it took too long, needed too much memory, or too many wait
"""

from __future__ import annotations

from rce_robot.exceptions import RobotError


class ConversionFailedError(RobotError):
    """A conversion was given up; the text is fit for an ``ER``."""
