"""Limits of containers: how much processor, memory and processes one may use, and what it does use."""

from rce_container.limits.base import Cell, CellUsage, Limiter, Limits, limits_of
from rce_container.limits.choice import choose_limiter
from rce_container.limits.rlimit import RlimitLimiter

__all__ = ["Cell", "CellUsage", "Limiter", "Limits", "RlimitLimiter", "choose_limiter", "limits_of"]
