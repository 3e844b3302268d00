"""The features that this machine offers to containers."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import NamedTuple

from rce.model import Network
from rce_container.exceptions import NetworkError, RuntimeUnavailableError
from rce_container.network import Networks
from rce_container.runtimes.base import Runtime
from rce_container.runtimes.podman import PodmanRuntime

_log = logging.getLogger(__name__)


class Offers(NamedTuple):
    """The features that containers can have here."""

    runtimes: tuple[str, ...]
    """Names; the runtime of containers without an image first."""
    networks: tuple[str, ...]
    """Values of :class:`rce.model.specs.Network`."""
    detail: str
    """The missing features, as text; empty if none is missing."""


def find_offers(runtime: Runtime, others: Iterable[Runtime]) -> Offers:
    """Find out which features work here. Blocks.

    Args:
        runtime: The runtime of containers without an image, which works.
        others: The other runtimes, which containers may ask for.
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
