"""Limits of containers for processor, memory and number of processes, and the actual usage."""

from rce_container.limits.base import ControlGroup, ControlGroupUsage, Limiter, Limits, limits_of
from rce_container.limits.choice import choose_limiter
from rce_container.limits.rlimit import RlimitLimiter

__all__ = [
    "ControlGroup",
    "ControlGroupUsage",
    "Limiter",
    "Limits",
    "RlimitLimiter",
    "choose_limiter",
    "limits_of",
]
