"""Conversions that would block the event loop for too long: their queues and worker processes."""

from rce_robot.conversion.jobs import ReadText, ReadValue, Result, Show
from rce_robot.conversion.pool import ConversionPool
from rce_robot.conversion.queue import ConversionQueue
from rce_robot.exceptions import ConversionFailedError

__all__ = [
    "ConversionFailedError",
    "ConversionPool",
    "ConversionQueue",
    "ReadText",
    "ReadValue",
    "Result",
    "Show",
]
