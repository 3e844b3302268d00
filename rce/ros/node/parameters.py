"""A node's access to the parameter server."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rce.ros import names
from rce.ros.errors import MasterRefused, ParameterMissing
from rce.ros.node.master import MasterClient

ParameterCallback = Callable[[str, Any], None]


class _Required:
    """Marks a parameter without a default."""


REQUIRED = _Required()
"""In place of a default: the parameter must be set."""


class Parameters:
    """Parameters by their global names."""

    def __init__(self, master: MasterClient) -> None:
        self._master = master
        self._watchers: dict[str, list[ParameterCallback]] = {}

    async def get(self, name: str, default: Any = REQUIRED) -> Any:
        """Return a parameter, or all of a namespace as a dictionary.

        Raises:
            ParameterMissing: It is not set and there is no default.
            MasterUnreachable: The master does not answer.
        """
        try:
            return await self._master.call("getParam", name)
        except MasterRefused as error:
            if default is REQUIRED:
                raise ParameterMissing(name) from error
            return default

    async def set(self, name: str, value: Any) -> None:
        """Set a parameter, or a whole namespace from a dictionary."""
        await self._master.call("setParam", name, value)

    async def has(self, name: str) -> bool:
        """Tell whether a parameter or namespace is set."""
        return bool(await self._master.call("hasParam", name))

    async def delete(self, name: str) -> None:
        """Delete a parameter or namespace.

        Raises:
            ParameterMissing: It is not set.
        """
        try:
            await self._master.call("deleteParam", name)
        except MasterRefused as error:
            raise ParameterMissing(name) from error

    async def search(self, name: str) -> str | None:
        """Look for a relative name in the node's namespace and then upwards; return the global name."""
        try:
            found: str = await self._master.call("searchParam", name)
        except MasterRefused:
            return None
        return found

    async def all_names(self) -> list[str]:
        """Return the names of all parameters of the graph."""
        found: list[str] = await self._master.call("getParamNames")
        return found

    async def watch(self, name: str, callback: ParameterCallback) -> Any:
        """Call ``callback(name, value)`` whenever a parameter, or one below it, is changed by others.

        Returns:
            The value now; an empty dictionary while it is not set.
        """
        self._watchers.setdefault(name, []).append(callback)
        return await self._master.call("subscribeParam", self._master.slave_uri, name)

    async def unwatch_all(self) -> None:
        """Stop watching."""
        while self._watchers:
            name, _ = self._watchers.popitem()
            await self._master.call("unsubscribeParam", self._master.slave_uri, name)

    def changed(self, name: str, value: Any) -> None:
        """Tell those who watch of a new value."""
        name = names.canonical(name)
        for watched, callbacks in self._watchers.items():
            if name == watched or name.startswith(watched.rstrip(names.SEPARATOR) + names.SEPARATOR):
                for callback in callbacks:
                    callback(name, value)
