"""The services by which tools read and set a node's log levels: ``~get_loggers`` and ``~set_logger_level``.

A node shows its own logger under the name ``rosout``, as rospy's nodes do, and the loggers below it.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from rce.ros.errors import ServiceFaultError
from rce.ros.node.service import SerializedHandler, coding

if TYPE_CHECKING:
    from rce.ros.node.runtime import Types

GET = "get_loggers", "roscpp/GetLoggers"
SET = "set_logger_level", "roscpp/SetLoggerLevel"

OWN = "rosout"
"""The name of a node's own logger on the graph."""

_LEVELS = {
    "debug": logging.DEBUG,
    "info": logging.INFO,
    "warn": logging.WARNING,
    "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}


class Loggers:
    """Answers for the loggers of one node."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger

    def handlers(self, types: Types) -> list[tuple[str, str, SerializedHandler]]:
        """Return name, type and handler of each service; the types are loaded at the first call."""

        def lazily(service_type: str, handler: Any) -> SerializedHandler:
            def answer(payload: bytes) -> Any:
                return coding(types.service(service_type), handler)(payload)

            return answer

        return [(*GET, lazily(GET[1], self.get)), (*SET, lazily(SET[1], self.set))]

    def get(self, _request: object) -> dict[str, Any]:
        """Return all loggers and the levels in effect."""
        return {
            "loggers": [
                {"name": name, "level": _word(logger.getEffectiveLevel())}
                for name, logger in self._all().items()
            ]
        }

    def set(self, request: Any) -> None:
        """Set the level of one logger.

        Raises:
            ServiceFaultError: The logger or the level does not exist.
        """
        logger = self._all().get(request.logger)
        if logger is None:
            raise ServiceFaultError(SET[0], f"there is no logger {request.logger!r}")
        level = _LEVELS.get(request.level.lower())
        if level is None:
            raise ServiceFaultError(SET[0], f"{request.level!r} is not one of {', '.join(_LEVELS)}")
        logger.setLevel(level)

    def _all(self) -> dict[str, logging.Logger]:
        below = self._logger.name + "."
        known = [name for name in self._logger.manager.loggerDict if name.startswith(below)]
        return {OWN: self._logger} | {
            f"{OWN}.{name[len(below) :]}": logging.getLogger(name) for name in known
        }


def _word(level: int) -> str:
    return next((word for word, floor in reversed(_LEVELS.items()) if level >= floor), "debug")
