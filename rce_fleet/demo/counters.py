"""What is known of the messages that were carried."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import aiohttp
from yarl import URL

from rce_fleet.demo.exceptions import DemoError

TIMEOUT = aiohttp.ClientTimeout(total=10)


@dataclass(frozen=True, slots=True)
class Counters:
    """Sums over all interfaces of the user, or over all nodes where there is no engine."""

    messages: int
    """Messages that interfaces, or nodes, received from their peers."""
    dropped: int | None
    """Messages that were given up because somebody was too slow; None if nobody says."""


async def read_counters(master: str, user: str, password: str) -> Counters:
    """Ask the engine's master.

    Raises:
        DemoError: It does not answer.
    """
    try:
        async with aiohttp.ClientSession(timeout=TIMEOUT, raise_for_status=True) as session:
            interfaces = await _interfaces(session, URL(master) / "api/v1", user, password)
    except (aiohttp.ClientError, TimeoutError, KeyError) as error:
        raise DemoError(f"the master does not say what it carried: {error}") from error
    return Counters(
        messages=sum(interface["messages_in"] for interface in interfaces),
        dropped=sum(interface["dropped"] for interface in interfaces),
    )


async def _interfaces(
    session: aiohttp.ClientSession, api: URL, user: str, password: str
) -> list[dict[str, Any]]:
    login = {"userID": user, "password": password, "label": "rce demo"}
    async with session.post(api / "login", json=login) as reply:
        token = (await reply.json())["token"]
    headers = {"Authorization": f"Bearer {token}"}
    try:
        async with session.get(api / "interfaces", params={"user": user}, headers=headers) as reply:
            found: list[dict[str, Any]] = (await reply.json())["interfaces"]
            return found
    finally:
        async with session.delete(api / "login", headers=headers):
            pass  # the token was given back
