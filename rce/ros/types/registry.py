"""Sources of message and service types: packages, the built-in definitions, connection headers."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rce.ros.packages import PackageIndex
from rce.ros.types.action import action_names, parse_action
from rce.ros.types.definition import SEPARATOR, Definition, parse_message, parse_service, split_full_text
from rce.ros.types.exceptions import BadDefinitionError, UnknownTypeError
from rce.ros.types.message import MessageType, ServiceType

if TYPE_CHECKING:
    from collections.abc import Callable

_NAME = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/([A-Za-z][A-Za-z0-9_]*)")
_PART = re.compile(r"(MSG|SRV|ACTION): (\S+)\n")


class _Text(NamedTuple):
    """A definition that was found."""

    text: str
    source: str
    first_line: int = 1
    """Number of the text's first line in its source."""


class TypeRegistry:
    """Finds types by name and makes each once.

    A definition is looked for in the packages first (``PKG/msg/Type.msg``, ``PKG/srv/Type.srv``, and
    ``PKG/action/Type.action`` for the message types of actions), then among the built-in ones of the common
    ROS packages, then among those learned with :meth:`from_definition`.

    Args:
        packages: The packages to search; None: those on the paths in the environment
        (:meth:`~rce.ros.packages.PackageIndex.from_environ`).
    """

    def __init__(self, packages: PackageIndex | None = None) -> None:
        self._packages = packages if packages is not None else PackageIndex.from_environ()
        self._messages: dict[str, MessageType] = {}
        self._services: dict[str, ServiceType] = {}
        self._learned: dict[str, MessageType] = {}

    def message(self, name: str) -> MessageType:
        """Return a message type.

        Args:
            name: ``package/Type``.

        Raises:
            UnknownTypeError: Its definition, or that of a type it uses, was not found.
            BadDefinitionError: Its definition, or one that it uses, is wrong.
        """
        found = self._messages.get(name)
        if found is None:
            try:
                found = _Builder(self._definition, self._messages).build(name)
            except UnknownTypeError:
                found = self._learned.get(name)
                if found is None:
                    raise
        return found

    def service(self, name: str) -> ServiceType:
        """Return a service type.

        Raises:
            UnknownTypeError: Its definition, or that of a type it uses, was not found.
            BadDefinitionError: Its definition, or one that it uses, is wrong.
        """
        found = self._services.get(name)
        if found is None:
            text, source, _ = self._text(name, "srv")
            request, response = (
                MessageType(part, self.message) for part in parse_service(name, text, source)
            )
            found = self._services[name] = ServiceType(name, request, response)
        return found

    def from_definition(self, name: str, full_text: str) -> MessageType:
        """Return the type that a full definition text describes, as a connection header carries it.

        The text alone counts: types of the same names that the registry knows are not used. The type is
        remembered, so that :meth:`message` finds it if no other definition exists.

        Raises:
            UnknownTypeError: The text uses a type that it does not hold.
            BadDefinitionError: The text cannot be read.
        """
        parts = dict(reversed(list(split_full_text(name, full_text))))

        def definition(wanted: str) -> Definition:
            if wanted not in parts:
                raise UnknownTypeError(wanted, f"the definition text of {name} does not hold it")
            return parse_message(wanted, parts[wanted])

        kind = _Builder(definition, {}).build(name)
        known = self._learned.get(name)
        if known is not None and known.md5sum == kind.md5sum:
            return known
        self._learned[name] = kind
        return kind

    def _definition(self, name: str) -> Definition:
        text, source, first_line = self._text(name, "msg")
        return parse_message(name, text, source, first_line)

    def _text(self, name: str, kind: str) -> _Text:
        """Return the definition text of ``name``."""
        match = _NAME.fullmatch(name)
        if match is None:
            raise UnknownTypeError(name, "a type is named package/Type")
        package, type_name = match.groups()
        folder = self._packages.locate(package)
        if folder is None:
            hint = f"no package {package} on the package path ({self._packages.describe_path()})"
        else:
            file = folder / kind / f"{type_name}.{kind}"
            if file.is_file():
                return _Text(_read(file.read_bytes(), str(file)), str(file))
            part = _action_text(folder, type_name) if kind == "msg" else None
            if part is not None:
                return part
            hint = f"there is no file {file}"
        text = builtin_definitions().get((kind, name))
        if text is None:
            builtin = "messages" if kind == "msg" else "services"
            raise UnknownTypeError(name, f"{hint}, and it is not among the built-in {builtin}")
        return _Text(text, name)


class _Builder:
    """Makes a message type and those it uses; refuses types that hold themselves."""

    def __init__(self, definition: Callable[[str], Definition], done: dict[str, MessageType]) -> None:
        self._definition = definition
        self._done = done
        self._open: list[str] = []

    def build(self, name: str) -> MessageType:
        found = self._done.get(name)
        if found is not None:
            return found
        definition = self._definition(name)
        if name in self._open:
            chain = " > ".join([*self._open, name])
            raise BadDefinitionError(definition.source, 0, f"the type holds itself: {chain}")
        self._open.append(name)
        try:
            kind = self._done[name] = MessageType(definition, self.build)
        finally:
            self._open.pop()
        return kind


def _action_text(folder: Path, type_name: str) -> _Text | None:
    """Return the text of a message type of an action that is defined in a package's folder."""
    for action, suffix in action_names(type_name):
        file = folder / "action" / f"{action}.action"
        if file.is_file():
            parts = parse_action(action, _read(file.read_bytes(), str(file)), str(file))
            return _Text(parts[suffix].text, str(file), parts[suffix].first_line)
    return None


def _read(data: bytes, source: str) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise BadDefinitionError(source, 0, f"is not UTF-8: {error.reason}") from error


@cache
def builtin_definitions() -> dict[tuple[str, str], str]:
    """Return the definitions that ship with the package: ``("msg" | "srv", name) -> text``."""
    text = Path(__file__).with_name("definitions.txt").read_text("utf-8")
    found: dict[tuple[str, str], str] = {}
    for section in text.split(SEPARATOR + "\n")[1:]:
        match = _PART.match(section)
        assert match is not None, section[:80]
        kind, name, definition = match[1], match[2], section[match.end() :]
        if kind == "ACTION":
            parts = parse_action(name.rpartition("/")[2], definition, name)
            found |= {("msg", name + suffix): part.text for suffix, part in parts.items()}
        else:
            found[kind.lower(), name] = definition
    return found
