"""What this machine can give to containers."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import NamedTuple

from rce.model.specs import Network
from rce_container.exceptions import NetworkError, RuntimeUnavailableError
from rce_container.network import Networks
from rce_container.runtimes.base import Runtime
from rce_container.runtimes.podman import PodmanRuntime

_log = logging.getLogger(__name__)


class Offers(NamedTuple):
    """What containers can have here."""

    runtimes: tuple[str, ...]
    """By name, the one of containers without an image first."""
    networks: tuple[str, ...]
    """Values of :class:`rce.model.specs.Network`."""
    detail: str
    """What is missing, in words; empty if nothing is."""


def find_offers(runtime: Runtime, others: Iterable[Runtime]) -> Offers:
    """Find out what works here. Blocks.

    Args:
        runtime: The one of containers without an image; it works.
        others: Those that containers may ask for.
    """
    runtimes = [runtime]
    details = []
    for other in others:
        if other is runtime or not isinstance(other, PodmanRuntime):
            continue
        try:
            other.probe()
        except RuntimeUnavailableError as error:
            _log.info("containers with an image cannot be made here: %s", error)
            if other.is_installed:
                details.append(str(error))
        else:
            other.close()
            runtimes.append(other)
    networks = [Network.NONE, Network.HOST]
    if any(one.isolated for one in runtimes):
        try:
            Networks().probe()
        except NetworkError as error:
            details.append(f"no networks of groups here: {error}")
        else:
            networks.append(Network.GROUP)
    names = tuple(one.name for one in runtimes)
    return Offers(names, tuple(one.value for one in networks), "; ".join(details))
