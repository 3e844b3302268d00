"""Custom forms of message types, registered by entry points.

A distribution adds a custom converter with an entry point of the group ``rce.converters``, whose name is the
message class and whose value is a class that :class:`CustomConverter` describes::

    [project.entry-points."rce.converters"]
    "sensor_msgs/Image" = "rce_robot.converters.image:ImageConverter"
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Protocol

ENTRY_POINTS = "rce.converters"
"""The entry point group."""

_SHIPPED = {"sensor_msgs/Image": "rce_robot.converters.image:ImageConverter"}
"""Converters that exist even if the package is not installed."""


class CustomConverter(Protocol):
    """Between a message's fields in JSON form and another form of it.

    It is used for every message of its class: as a whole, as a field, in an array.
    """

    def encode(self, fields: dict[str, Any]) -> Any:
        """Return the form to send: a binary value, any JSON value, or the unchanged fields."""

    def decode(self, value: Any) -> dict[str, Any]:
        """Return the fields of a received form. Not called for JSON objects: they are fields already.

        Raises:
            ValueError: It is not a form of the message; the text says why.
        """


def load_custom_converters() -> dict[str, CustomConverter]:
    """Return the converter of each class that has one; installed converters override shipped ones."""
    from importlib.metadata import entry_points

    found: dict[str, CustomConverter] = {
        point.name: point.load()() for point in entry_points(group=ENTRY_POINTS)
    }
    for name, target in _SHIPPED.items():
        if name not in found:
            module, _, attribute = target.partition(":")
            found[name] = getattr(import_module(module), attribute)()
    return found
