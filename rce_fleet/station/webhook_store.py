"""The webhooks of a station: who gets which events, and how far each receiver is. Kept in a file."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import secrets
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
from msgspec import Struct
from yarl import URL

from rce_fleet.api.webhooks import WebhookRequest
from rce_fleet.exceptions import RequestRefusedError
from rce_fleet.station.private_files import fleet_file, write_private

_log = logging.getLogger(__name__)

MAX_WEBHOOKS = 20
FORMER = "webhooks.json"
"""The file of earlier releases, for all fleets whose stations share the folder."""


_NONE = len(msgspec.json.encode([]))
"""Bytes of a file without webhooks."""


class Webhook(Struct, kw_only=True):
    """A receiver of events.

    Attributes:
        position: Number of the last event that is done.
        journal: Which journal numbered it; empty: not known.
        failures: Failed deliveries in a row.
        error: Why the last delivery failed.
        next_attempt: Seconds since 1970; None: at the next event.
    """

    id: str
    url: str
    secret: str
    kinds: tuple[str, ...] = ()
    allow_private: bool = False
    created_by: str = ""
    position: int
    journal: str = ""
    failures: int = 0
    error: str = ""
    next_attempt: float | None = None

    def __repr__(self) -> str:
        return f"Webhook(id={self.id!r}, url={self.url!r})"


def webhooks_file(folder: Path, fleet: str) -> Path:
    """Return the file of a fleet's webhooks.

    Args:
        folder: The folder.
        fleet: What tells the fleet from others.
    """
    return fleet_file(folder, "webhooks", fleet)


class WebhookStore:
    """All webhooks, in memory and in a file that only its owner reads.

    Args:
        file: The file; None keeps them in memory only.
    """

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self._saving = threading.Lock()
        """A save goes on in its thread when the task that waits for it is cancelled."""
        self._webhooks: dict[str, Webhook] = {}

    def load(self) -> None:
        """Read the file; a missing one holds none. Blocks.

        Raises:
            OSError: It cannot be read.
            msgspec.DecodeError: It is damaged.
        """
        if self._file is None:
            return
        source = self._source(self._file)
        if not source.exists():
            self._tell_of_others(self._file)
            return
        found = msgspec.json.decode(source.read_bytes(), type=list[Webhook])
        self._webhooks = {webhook.id: webhook for webhook in found}

    def _source(self, file: Path) -> Path:
        """Return the file to read: the fleet's own one, which that of earlier releases becomes."""
        former = file.with_name(FORMER)
        if file.exists() or not former.exists():
            return file
        try:
            return former.rename(file)
        except FileNotFoundError:  # another station was faster
            return file
        except OSError:  # the folder cannot be written
            return former

    def _tell_of_others(self, file: Path) -> None:
        """Say once which webhooks may be this fleet's, too: with another URL it is another fleet here."""
        others = sorted(
            path.name for path in file.parent.glob("webhooks-*.json") if path.stat().st_size > _NONE
        )
        if not others:
            return
        _log.warning(
            "this fleet has no webhooks yet. If those in %s are of this fleet, under another URL or robotID,"
            " end the station and rename that file to %s, in %s",
            *(" or ".join(others), file.name, file.parent),
        )
        with contextlib.suppress(OSError):
            self.save()

    def __iter__(self) -> Iterator[Webhook]:
        return iter(list(self._webhooks.values()))

    def get(self, id_: str) -> Webhook | None:
        """Find a webhook."""
        return self._webhooks.get(id_)

    def add(self, request: WebhookRequest, user: str, position: int, journal: str = "") -> Webhook:
        """Add a webhook that gets events of a journal after a number; :meth:`save` keeps it.

        Raises:
            RequestRefusedError: The URL cannot be one, or there are too many.
        """
        check_url(request.url, allow_private=request.allow_private)
        if len(self._webhooks) >= MAX_WEBHOOKS:
            raise RequestRefusedError(f"there are {MAX_WEBHOOKS} webhooks already; remove one first")
        made = Webhook(
            id=secrets.token_hex(6),
            url=request.url,
            secret=request.secret or secrets.token_urlsafe(32),
            kinds=tuple(request.kinds),
            allow_private=request.allow_private,
            created_by=user,
            position=position,
            journal=journal,
        )
        self._webhooks[made.id] = made
        return made

    def remove(self, id_: str) -> bool:
        """Remove a webhook; return whether it was there."""
        return self._webhooks.pop(id_, None) is not None

    def put_back(self, webhook: Webhook) -> None:
        """Have a webhook again that was removed."""
        self._webhooks[webhook.id] = webhook

    def save(self) -> None:
        """Write the file, whole or not at all. Blocks.

        Raises:
            OSError: It cannot be written.
        """
        if self._file is None:
            return
        with self._saving:
            write_private(self._file, msgspec.json.encode(list(self._webhooks.values())))


def check_url(url: str, *, allow_private: bool) -> None:
    """Check where events may be sent; names are looked up, and checked again, at each delivery.

    Raises:
        RequestRefusedError: It is not http or https, holds a password, or names a private address.
    """
    try:
        parts = urlsplit(url)
        host, _ = (
            URL(url).raw_host or "",
            parts.port,
        )  # as it is connected to: other digits and dots are replaced
    except ValueError as error:
        raise RequestRefusedError(f"url {url!r:.80}: {error}") from error
    if parts.scheme not in ("http", "https") or not host:
        raise RequestRefusedError(f"url must be http://... or https://..., not {url!r:.80}")
    if parts.username is not None or parts.password is not None:
        raise RequestRefusedError("url must not hold a name or password; deliveries are signed instead")
    if not allow_private and (host.rstrip(".") == "localhost" or is_private(host)):
        raise RequestRefusedError(
            f"{host} is on this machine or in a private network; if events shall go there, set allow_private"
        )


_CARRIERS = tuple(map(ipaddress.IPv6Network, ("64:ff9b::/96", "::/96")))
"""IPv6 addresses whose last 32 bits are an IPv4 address: NAT64, and the older form of mapped addresses."""
_LOCAL_NAT64 = ipaddress.IPv6Network("64:ff9b:1::/48")


def is_private(address: str) -> bool:
    """Whether an IP address is not one of the public Internet; False for names.

    An IPv6 address that carries an IPv4 address (mapped, NAT64, 6to4) is as private as that one. Digits and
    dots that are not a whole address, such as ``127.1``, count as private: they are not looked up as names.
    """
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address.replace(".", "").isdigit()
    if isinstance(found, ipaddress.IPv6Address):
        carried = found.ipv4_mapped or found.sixtofour
        if any(found in network for network in _CARRIERS):
            carried = ipaddress.IPv4Address(int(found) & 0xFFFF_FFFF)
        if found in _LOCAL_NAT64:
            return True
        if carried is not None:  # newer Pythons take no 6to4 address for a public one
            return not carried.is_global
    return not found.is_global
