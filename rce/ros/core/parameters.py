"""The parameter tree. Pure.

Parameters are the leaves of a tree of dictionaries; a name is a path in it. Setting a dictionary replaces the
whole branch. Subscribers of a name hear of changes of it, above it and below it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from typing import Any

from rce.ros import names
from rce.ros.xmlrpc.dispatch import BadArgumentError

Tree = dict[str, Any]

UNSET: Tree = {}
"""The value that a subscriber gets for a parameter that is not set."""


class ParameterTree:
    """All parameters of a core."""

    def __init__(self) -> None:
        self._root: Tree = {}

    def get(self, name: str) -> Any:
        """Return a parameter or, as a dictionary, all of a namespace.

        Raises:
            KeyError: Neither exists.
        """
        value: Any = self._root
        for segment in names.segments(name):
            if not isinstance(value, dict):
                raise KeyError(name)
            value = value[segment]
        return value

    def has(self, name: str) -> bool:
        """Return whether ``name`` is a parameter or a namespace of some."""
        try:
            self.get(name)
        except KeyError:
            return False
        return True

    def set(self, name: str, value: Any) -> None:
        """Set a parameter, or replace a whole namespace by a dictionary.

        Raises:
            BadArgumentError: The root would become something other than a namespace.
        """
        path = names.segments(name)
        value = copy.deepcopy(value)
        if not path:
            if not isinstance(value, dict):
                raise BadArgumentError("the root of the parameters must be a dictionary")
            self._root = value
            return
        branch = self._root
        for segment in path[:-1]:
            below = branch.get(segment)
            if not isinstance(below, dict):
                below = branch[segment] = {}
            branch = below
        branch[path[-1]] = value

    def delete(self, name: str) -> None:
        """Remove a parameter or a whole namespace.

        Raises:
            KeyError: It is not set.
        """
        path = names.segments(name)
        if not path:
            raise KeyError(name)
        branch = self.get(names.SEPARATOR.join(path[:-1]))
        if not isinstance(branch, dict):
            raise KeyError(name)
        del branch[path[-1]]

    def all_names(self) -> list[str]:
        """Return the names of all parameters (of leaves, not of namespaces)."""
        return list(_leaves("", self._root))

    def search(self, start: str, name: str) -> str | None:
        """Look for ``name`` in the namespace ``start`` (a node's name) and then upwards.

        Only the first segment of ``name`` decides where it is found, as in ROS: the full name that is
        returned need not be set.
        """
        if names.is_global(name):
            return name if self.has(name) else None
        first = names.segments(name)[0]
        path = names.segments(start)
        for length in range(len(path), -1, -1):
            namespace = names.SEPARATOR + names.SEPARATOR.join(path[:length])
            if self.has(names.join(namespace, first)):
                return names.join(namespace, name)
        return None


def affected(subscribed: Iterable[str], name: str) -> Iterator[tuple[str, str]]:
    """Return the subscriptions that a change of ``name`` concerns.

    Yields:
        ``(subscribed name, name to report)``: a subscriber of a namespace is told the changed parameter;
        a subscriber of something inside a changed namespace is told its own name.
    """
    changed = name.rstrip(names.SEPARATOR) + names.SEPARATOR
    for subscription in subscribed:
        scope = subscription.rstrip(names.SEPARATOR) + names.SEPARATOR
        if changed.startswith(scope):
            yield subscription, name
        elif scope.startswith(changed):
            yield subscription, subscription


def _leaves(prefix: str, branch: Tree) -> Iterator[str]:
    for key, value in branch.items():
        name = f"{prefix}/{key}"
        if isinstance(value, dict):
            yield from _leaves(name, value)
        else:
            yield name
