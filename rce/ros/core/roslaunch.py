"""The core's answers to tools that expect a ``roslaunch`` process, as ``roscore`` is one.

Tools find the address in the parameters below ``/roslaunch/uris`` and ask there for the processes that were
started. A core starts none.
"""

from __future__ import annotations

import os

from rce.ros.xmlrpc.dispatch import ERROR, SUCCESS, Method


def roslaunch_methods() -> dict[str, Method]:
    """Return the method table. These methods take no caller's name."""
    return {
        "get_pid": lambda: (SUCCESS, str(os.getpid()), os.getpid()),
        "get_node_names": lambda: (SUCCESS, "node names", []),
        "list_processes": lambda: (SUCCESS, "processes on parent machine", [[], []]),
        "list_children": lambda: (SUCCESS, "roslaunch children", []),
        "process_info": lambda _name: (ERROR, "no process by that name", {}),
    }
