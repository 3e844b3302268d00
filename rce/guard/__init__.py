"""Limits on a process's resources for unauthenticated connections and users."""

from rce.guard.budget import Ledger
from rce.guard.holdings import Holding, Holdings
from rce.guard.lobby import PER_ADDRESS, Guest, Lobby, address_of
from rce.guard.loop_share import LoopShare
from rce.guard.places import NoPlaceError, Places
from rce.guard.proxies import TrustedProxies
from rce.guard.rates import LogThrottle, Rates
from rce.guard.turns import CrowdedError, Turns

__all__ = [
    "PER_ADDRESS",
    "CrowdedError",
    "Guest",
    "Holding",
    "Holdings",
    "Ledger",
    "Lobby",
    "LogThrottle",
    "LoopShare",
    "NoPlaceError",
    "Places",
    "Rates",
    "TrustedProxies",
    "Turns",
    "address_of",
]
