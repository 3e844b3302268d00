"""Carries out a launch plan: a master if there is none, parameters, and nodes as processes until they end.

:class:`~rce.ros.launching.launcher.Launcher` does what ``roslaunch`` does with its files.
"""

from rce.ros.launching.launched import StopTimeouts
from rce.ros.launching.launcher import Launcher

__all__ = ["Launcher", "StopTimeouts"]
