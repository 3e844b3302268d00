"""Reads a node's private parameters into a dataclass, as all nodes of the fleet do.

The node always starts: a value that cannot be used is reported as an error on ``/rosout``, and the default is
used. An unknown parameter is a warning that names the nearest known one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeVar

from rce_fleet.nodes.parameter_values import read_values, searched_names

if TYPE_CHECKING:
    from collections.abc import Sequence

    from _typeshed import DataclassInstance

    from rce.ros.node import Node

T = TypeVar("T", bound="DataclassInstance")


async def read_parameters(node: Node, kind: type[T], *, unused: Sequence[str] = ()) -> T:
    """Return a node's private parameters; report those that are unknown or cannot be used.

    Args:
        node: A running node.
        kind: A frozen dataclass that declares the parameters (:mod:`rce_fleet.nodes.parameter_values`).
        unused: Names of parameters that ROS 1's node of this name has, and this one does not use.

    Raises:
        MasterUnreachableError: The master does not answer.

    Example:
        ```python
        async with Node("amcl") as node:
            parameters = await read_parameters(node, AmclParameters)
        ```
    """
    found = await node.get_param("~", {})
    outer = {}
    for name in sorted(searched_names(kind)):
        place = await node.search_param(name)
        if place is not None:
            outer[name] = await node.get_param(place, None)
    prefix = node.resolve("~").rstrip("/") + "/"
    values = found if isinstance(found, Mapping) else {}
    parameters, problems = read_values(kind, values, outer=outer, prefix=prefix, unused=unused)
    for problem in problems:
        (node.log.warning if problem.is_unknown else node.log.error)("%s", problem.text)
    return parameters
