"""What the engine says of the messages it carried."""

from __future__ import annotations

from dataclasses import dataclass

import aiohttp
from yarl import URL

from rce_client.demo.exceptions import DemoError

TIMEOUT = aiohttp.ClientTimeout(total=10)


@dataclass(frozen=True, slots=True)
class Counters:
    """Sums over all interfaces of the user."""

    messages: int
    """Messages that interfaces received from their peers."""
    dropped: int
    """Messages that were given up because somebody was too slow."""


async def read_counters(session: aiohttp.ClientSession, master: str, user: str, password: str) -> Counters:
    """Ask the master.

    Raises:
        DemoError: It does not answer.
    """
    api = URL(master) / "api/v1"
    try:
        login = {"userID": user, "password": password, "label": "rce demo"}
        async with session.post(api / "login", json=login, timeout=TIMEOUT, raise_for_status=True) as reply:
            token = (await reply.json())["token"]
        headers = {"Authorization": f"Bearer {token}"}
        async with session.get(
            api / "interfaces", params={"user": user}, headers=headers, timeout=TIMEOUT, raise_for_status=True
        ) as reply:
            interfaces = (await reply.json())["interfaces"]
    except (aiohttp.ClientError, TimeoutError, KeyError) as error:
        raise DemoError(f"the master does not say what it carried: {error}") from error
    return Counters(
        messages=sum(interface["messages_in"] for interface in interfaces),
        dropped=sum(interface["dropped"] for interface in interfaces),
    )
