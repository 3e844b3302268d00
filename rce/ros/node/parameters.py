"""A node's access to the parameter server."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from rce.ros import names
from rce.ros.errors import (
    MalformedDocumentError,
    MasterRefusedError,
    ParameterMissingError,
    ParameterValueError,
)
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc.codec import encode_response

_log = logging.getLogger(__name__)

ParameterCallback = Callable[[str, Any], None]


class _Required:
    """Marks a parameter without a default."""


UNSET: dict[str, Any] = {}
"""The value that a master reports for a parameter that is not set."""

REQUIRED = _Required()
"""In place of a default: the parameter must be set."""


class Parameters:
    """Parameters by their global names."""

    def __init__(self, master: MasterClient) -> None:
        self._master = master
        self._watchers: dict[str, list[ParameterCallback]] = {}
        self._known: dict[str, Any] = {}
        """The values of subscribed parameters, as the master reported them."""
        self._early: dict[str, list[tuple[str, Any]]] = {}
        """Changes that the master reported before its answer to a subscription."""

    async def get(self, name: str, default: Any = REQUIRED) -> Any:
        """Return a parameter, or all of a namespace as a dictionary.

        Raises:
            ParameterMissingError: It is not set, and no default is given.
            MasterUnreachableError: The master does not answer.
        """
        try:
            return await self._master.call("getParam", name)
        except MasterRefusedError as error:
            if default is REQUIRED:
                raise ParameterMissingError(name) from error
            return default

    async def get_cached(self, name: str, default: Any = REQUIRED) -> Any:
        """Return a parameter as the master reported it last; only the first call asks the master.

        An empty namespace counts as not set. The value must not be changed.

        Raises:
            ParameterMissingError: It is not set, and no default is given.
            MasterUnreachableError: The master does not answer.
        """
        if name not in self._known:
            await self._subscribe(name)
        value = self._known[name]
        if value != UNSET:
            return value
        if default is REQUIRED:
            raise ParameterMissingError(name)
        return default

    async def set(self, name: str, value: Any) -> None:
        """Set a parameter, or a whole namespace from a dictionary.

        Raises:
            ParameterValueError: XML-RPC has no form for the value, or for one in it; nothing was set.
            MasterUnreachableError: The master does not answer.
        """
        try:
            await self._master.call("setParam", name, value)
        except MalformedDocumentError as error:
            raise ParameterValueError(*_unsendable(name, value, str(error))) from error
        self._note(name, value)  # the master reports a change to all nodes except the one that made it

    async def has(self, name: str) -> bool:
        """Return whether a parameter or namespace is set."""
        return bool(await self._master.call("hasParam", name))

    async def delete(self, name: str) -> None:
        """Delete a parameter or namespace.

        Raises:
            ParameterMissingError: It is not set.
        """
        try:
            await self._master.call("deleteParam", name)
        except MasterRefusedError as error:
            raise ParameterMissingError(name) from error
        self._note(name, UNSET)

    async def search(self, name: str) -> str | None:
        """Look for a relative name in the node's namespace and then upwards; return the global name."""
        try:
            found: str = await self._master.call("searchParam", name)
        except MasterRefusedError:
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
        await self._subscribe(name)
        return self._known[name]

    async def unwatch_all(self) -> None:
        """Stop watching."""
        self._watchers.clear()
        while self._known:
            name, _ = self._known.popitem()
            await self._master.call("unsubscribeParam", self._master.slave_uri, name)

    async def renew(self) -> None:
        """Subscribe again at a master that lost the subscriptions; call the watchers of changed values."""
        for name, before in list(self._known.items()):
            await self._subscribe(name)
            if self._known[name] != before:
                self._tell(name, self._known[name])

    def changed(self, name: str, value: Any) -> bool:
        """Take a new value and call the watchers; return whether the parameter was subscribed to."""
        name = names.canonical(name)
        is_known = self._note(name, value)
        self._tell(name, value)
        return is_known

    async def _subscribe(self, name: str) -> None:
        early = self._early.setdefault(name, [])
        try:
            self._known[name] = await self._master.call("subscribeParam", self._master.slave_uri, name)
        finally:
            self._early.pop(name, None)
        for changed, value in early:
            self._note(changed, value)

    def _note(self, name: str, value: Any) -> bool:
        """Update the cached values of a parameter, of the namespaces above it and of everything below it."""
        path = names.segments(name)
        is_known = False
        for known in self._known:
            own = names.segments(known)
            if path[: len(own)] == own:
                self._known[known] = _replaced(self._known[known], path[len(own) :], value)
                is_known = True
            elif own[: len(path)] == path:
                self._known[known] = _within(value, own[len(path) :])
                is_known = True
        for awaited, changes in self._early.items():
            own = names.segments(awaited)
            if path[: len(own)] == own or own[: len(path)] == path:
                changes.append((name, value))
                is_known = True
        return is_known

    def _tell(self, name: str, value: Any) -> None:
        for watched, callbacks in self._watchers.items():
            if name == watched or name.startswith(watched.rstrip(names.SEPARATOR) + names.SEPARATOR):
                for callback in callbacks:
                    _call(callback, name, value)


def _call(callback: ParameterCallback, name: str, value: Any) -> None:
    try:
        callback(name, value)
    except Exception:  # noqa: BLE001 - the program's own fault: others hear of the change, and the node goes on
        _log.exception("the callback of parameter %s failed", name)


def _replaced(tree: Any, path: list[str], value: Any) -> Any:
    """Return a copy of a tree with another value at a path; an unset one is left out."""
    if not path:
        return value
    if value == UNSET and not isinstance(tree, dict):
        return tree  # a value has no parameters below it, so nothing was removed
    branch = dict(tree) if isinstance(tree, dict) else {}
    below = _replaced(branch.get(path[0], UNSET), path[1:], value)
    if len(path) == 1 and below == UNSET:
        branch.pop(path[0], None)
    else:
        branch[path[0]] = below
    return branch


def _within(tree: Any, path: list[str]) -> Any:
    """Return the part of a tree at a path."""
    for segment in path:
        if not isinstance(tree, dict) or segment not in tree:
            return UNSET
        tree = tree[segment]
    return tree


def _unsendable(name: str, value: Any, reason: str) -> tuple[str, str]:
    """Return the innermost place of a value that cannot be sent, and the reason."""
    inner: list[tuple[str, Any]] = []
    if isinstance(value, dict):
        inner = [(f"{name}/{key}", each) for key, each in value.items() if isinstance(key, str)]
    elif isinstance(value, list | tuple):
        inner = [(f"{name}[{index}]", each) for index, each in enumerate(value)]
    for place, each in inner:
        try:
            encode_response(each)
        except MalformedDocumentError as error:
            return _unsendable(place, each, str(error))
    return name, reason
