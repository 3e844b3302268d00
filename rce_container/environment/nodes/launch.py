"""The arguments and the environment of a node's process."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

from rce.model import NodeSpec
from rce.ros.substitution import split_arguments
from rce.ros.system import system_environ
from rce_container.environment.exceptions import NodeError
from rce_container.environment.user_packages import LaunchEnvironment

NODE_MARK = "RCE_NODE"
"""Environment variable that every process of a node carries; its value names one life of one node."""


OWN_NODE = "rce_environment"
"""The environment's own node in the container's graph; a second one of that name would end it."""


class Launch(NamedTuple):
    """How to start a node."""

    argv: list[str]
    env: dict[str, str]
    ros_name: str
    """The global ROS name that it is to take; empty if it chooses its own name."""
    choice: str = ""
    """For its log: which of several programs of its name was chosen; empty if there is only one."""


def ros_name_of(spec: NodeSpec) -> str:
    """Return the global ROS name of a node that takes the name it is given; its tag, if it is given none."""
    return "/" + "/".join(filter(None, (spec.namespace.strip("/"), spec.name or spec.tag)))


def prepare(launch_environment: LaunchEnvironment, mark: str) -> Launch:
    """Work out how to start a node.

    Args:
        launch_environment: The folders and variables of its launch.
        mark: The value of :data:`NODE_MARK`.

    Raises:
        NodeError: It cannot be started; the text says what to do.
    """
    spec, packages = launch_environment.spec, launch_environment.packages
    environ: Mapping[str, str] = launch_environment.environ
    try:
        executable, package, choice, _ = packages.find(spec.pkg).program(spec.exe)
        arguments = split_arguments(spec.args, packages, environ)
    except (LookupError, ValueError, OSError) as error:
        raise NodeError(str(error)) from error
    namespace = spec.namespace.strip("/")
    if package.python == "system":
        environ = system_environ(environ, package.path)
    env = {**environ, NODE_MARK: mark}
    if launch_environment.python_path:
        env["PYTHONPATH"] = os.pathsep.join(
            filter(None, (launch_environment.python_path, env.get("PYTHONPATH", "")))
        )
    if spec.name:
        arguments.append(f"__name:={spec.name}")
    if namespace:
        arguments.append(f"__ns:=/{namespace}")
        env["ROS_NAMESPACE"] = f"/{namespace}"
    ros_name = "/" + "/".join(filter(None, (namespace, spec.name))) if spec.name else ""
    if ros_name == f"/{OWN_NODE}":
        raise NodeError(
            f"{ros_name} is the node that joins the container to others; give this one another name"
        )
    return Launch([*executable, *arguments], env, ros_name, choice)
