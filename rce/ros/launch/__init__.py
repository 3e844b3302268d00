"""Launch files: which nodes start together, with which parameters. As ``roslaunch`` reads them.

:func:`~rce.ros.launch.loader.load_launch_files` reads files into a :class:`~rce.ros.launch.plan.LaunchPlan`;
:mod:`rce.ros.launching` carries the plan out.
"""

from rce.ros.launch.exceptions import LaunchError, LaunchFileError
from rce.ros.launch.inputs import LaunchInputs, MachineInputs
from rce.ros.launch.loader import load_launch_files
from rce.ros.launch.plan import LaunchPlan, NodePlan, Output, ParameterCommand, WorkingFolder

__all__ = [
    "LaunchError",
    "LaunchFileError",
    "LaunchInputs",
    "LaunchPlan",
    "MachineInputs",
    "NodePlan",
    "Output",
    "ParameterCommand",
    "WorkingFolder",
    "load_launch_files",
]
