"""What a node's process is started with: its arguments and its environment."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from typing import NamedTuple

from rce.control.model import NodeSpec
from rce.ros.packages import PackageIndex
from rce.ros.substitution import substitute
from rce_container.environment.exceptions import NodeError

NODE_MARK = "RCE_NODE"
"""Environment variable that every process of a node carries; its value names one life of one node."""

_SUBSTITUTION = re.compile(r"\$\([^()]*\)")
_PLACEHOLDER = re.compile("\0([0-9]+)\0")


class Launch(NamedTuple):
    """How to start a node."""

    argv: list[str]
    env: dict[str, str]
    ros_name: str
    """The global ROS name that it was told to take; empty if it chooses by itself."""


def split_arguments(text: str, packages: PackageIndex, environ: Mapping[str, str]) -> list[str]:
    """Split a node's arguments as a POSIX shell splits words, and substitute ``$(find PKG)`` and ``$(env VAR)``.

    What is substituted stays inside its word, whatever it holds, and nothing is ever given to a shell.

    Raises:
        ValueError: A quote is open, or a substitution cannot be made.
    """
    if "\0" in text:
        raise ValueError("arguments must not hold a NUL character")
    found: list[str] = []

    def hide(match: re.Match[str]) -> str:
        found.append(substitute(match[0], packages, environ))
        return f"\0{len(found) - 1}\0"

    words = shlex.split(_SUBSTITUTION.sub(hide, text))
    return [_PLACEHOLDER.sub(lambda match: found[int(match[1])], word) for word in words]


def prepare(spec: NodeSpec, packages: PackageIndex, environ: Mapping[str, str], mark: str) -> Launch:
    """Work out how to start a node.

    Args:
        spec: The node.
        packages: Where packages are found.
        environ: The environment of all nodes.
        mark: The value of :data:`NODE_MARK`.

    Raises:
        NodeError: It cannot be started; the text says what to do.
    """
    try:
        executable = packages.find(spec.pkg).executable(spec.exe)
        arguments = split_arguments(spec.args, packages, environ)
    except (LookupError, ValueError, OSError) as error:
        raise NodeError(str(error)) from error
    namespace = spec.namespace.strip("/")
    env = {**environ, NODE_MARK: mark}
    if spec.name:
        arguments.append(f"__name:={spec.name}")
    if namespace:
        arguments.append(f"__ns:=/{namespace}")
        env["ROS_NAMESPACE"] = f"/{namespace}"
    ros_name = "/" + "/".join(filter(None, (namespace, spec.name))) if spec.name else ""
    return Launch([*executable, *arguments], env, ros_name)
