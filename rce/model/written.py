"""The form in which users write the fields of specs: valid texts, and messages for wrong ones.

The types are checked when messages of users are decoded. The engine's own specs (:mod:`rce.model.specs`) name
them by :class:`AsWritten`, which does not bind what the engine stores and sends between its own programs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from msgspec import Meta

from rce.model.names import (
    MAX_NAME_LENGTH,
    MAX_VERSION_LENGTH,
    MESSAGE_TYPE_PATTERN,
    NAME_PATTERN,
    VERSION_PATTERN,
    Form,
    Role,
)

if TYPE_CHECKING:
    from collections.abc import Callable

ROS_NAME_PATTERN = r"[~/]?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*"
"""Valid names of ROS topics, services, parameters and namespaces."""

_TYPE_PATTERN = f"({'|'.join(r.value for r in Role)})({'|'.join(f.value for f in Form)})"
# Grouped, so that it differs from MESSAGE_TYPE_PATTERN and has its own text in HUMAN_PATTERNS.
_INTERFACE_PATH_PATTERN = rf"({NAME_PATTERN})/({NAME_PATTERN})"
_EXECUTABLE_PATTERN = r"(?!/)(?!(.*/)?\.\.(/|\Z))[^\x00-\x1f\x7f]+"

Name = Annotated[str, Meta(pattern=rf"^{NAME_PATTERN}\Z", max_length=MAX_NAME_LENGTH)]
"""Names a user, robot, container, node or interface."""
PackageName = Annotated[
    str,
    Meta(
        pattern=rf"^{NAME_PATTERN}(@{VERSION_PATTERN})?\Z",
        max_length=MAX_NAME_LENGTH + 1 + MAX_VERSION_LENGTH,
    ),
]
"""A package, ``NAME``, or a version of one that a user brought, ``NAME@VERSION``."""
MessageTypeName = Annotated[str, Meta(pattern=rf"^{MESSAGE_TYPE_PATTERN}\Z", max_length=2 * MAX_NAME_LENGTH)]
"""A message or service type, ``package/Type``."""
InterfaceTypeName = Annotated[str, Meta(pattern=rf"^{_TYPE_PATTERN}\Z")]
"""An interface type such as ``PublisherConverter``."""
RosName = Annotated[str, Meta(pattern=rf"^{ROS_NAME_PATTERN}\Z", max_length=255)]
"""A ROS name."""
OptionalRosName = Annotated[str, Meta(pattern=rf"^({ROS_NAME_PATTERN})?\Z", max_length=255)]
"""A ROS name or the empty string."""
OptionalName = Annotated[str, Meta(pattern=rf"^({NAME_PATTERN})?\Z", max_length=MAX_NAME_LENGTH)]
"""A name or the empty string."""
OptionalNamespace = Annotated[str, Meta(pattern=rf"^(/|{ROS_NAME_PATTERN}/?)?\Z", max_length=255)]
"""A ROS namespace or the empty string."""
Executable = Annotated[str, Meta(pattern=rf"^{_EXECUTABLE_PATTERN}\Z", max_length=255)]
"""A file below a package's folders; never absolute, never above the package."""
InterfacePath = Annotated[str, Meta(pattern=rf"^{_INTERFACE_PATH_PATTERN}\Z", max_length=2 * MAX_NAME_LENGTH)]
"""An interface of an endpoint, ``ENDPOINT/INTERFACE``."""
Text = Annotated[str, Meta(max_length=65536, pattern=r"^[^\x00]*\Z")]
"""Free text without a NUL, which arguments and file names must not hold."""
Quantity: TypeAlias = int | float | Text
"""An amount, as :mod:`rce.model.quantities` reads it."""
NetworkName: TypeAlias = Literal["", "none", "group", "host"]
"""A container's access to the network; empty for the default."""
RestartName: TypeAlias = Literal["never", "on-failure", "always"]
"""When a node that ended is started again."""
Scalar: TypeAlias = bool | int | float | str
Value: TypeAlias = bool | int | float | str | list[Scalar]
"""A parameter's value."""

HUMAN_PATTERNS: dict[str, str] = {
    rf"^{NAME_PATTERN}\Z": "must be a name: letters, digits and '_', a letter first",
    rf"^({NAME_PATTERN})?\Z": "must be a name: letters, digits and '_', a letter first",
    rf"^{NAME_PATTERN}(@{VERSION_PATTERN})?\Z": (
        "must be a package's name (letters, digits and '_', a letter first), or NAME@VERSION such as"
        " nav@1.2.0"
    ),
    rf"^{MESSAGE_TYPE_PATTERN}\Z": "must be a class of the form package/Type",
    rf"^{_TYPE_PATTERN}\Z": (
        f"must be an interface type: one of {', '.join(r.value for r in Role)},"
        f" followed by one of {', '.join(f.value for f in Form)}"
    ),
    rf"^{ROS_NAME_PATTERN}\Z": "must be a ROS name such as /group/topic",
    rf"^({ROS_NAME_PATTERN})?\Z": "must be a ROS name such as /group/topic",
    rf"^(/|{ROS_NAME_PATTERN}/?)?\Z": "must be a ROS namespace such as /Robot1",
    rf"^{_EXECUTABLE_PATTERN}\Z": "must be the name of a file inside the package",
    rf"^{_INTERFACE_PATH_PATTERN}\Z": "must have the form ENDPOINT/INTERFACE",
    r"^[^\x00]*\Z": "must not hold a NUL character",
}
"""Text for users in place of a regular expression."""


def _same(value: Any) -> Any:
    return value


class AsWritten:
    """The form in which users write a field: its type, and the conversion to the value that the engine keeps.

    Put it in the annotation of the field: ``cpu: Annotated[float, AsWritten(Quantity, read_cores)]``.

    Args:
        type: Type of the written value; msgspec checks it.
        read: Converts the written value to the kept one; raises :class:`ValueError` with a text for the user.
        write: Converts the kept value to a written one, so that ``read`` returns the same again.
        blank: What users may write for "not given".
        words: Text on what is valid, where neither ``read`` nor the type's pattern has one.
    """

    def __init__(
        self,
        type: Any,  # noqa: A002 - of what is written
        read: Callable[[Any], Any] = _same,
        write: Callable[[Any], Any] = _same,
        *,
        blank: Any = None,
        words: str = "",
    ) -> None:
        self.type = type
        self.read = read
        self.write = write
        self.blank = blank
        self.words = words
