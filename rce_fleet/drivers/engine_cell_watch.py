"""Watches the cells that people block through the engine."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rce_client.connection import Connection
from rce_fleet.drivers.cell_watch import CELLS, TOPIC, grid_of

if TYPE_CHECKING:
    from rce_fleet.drivers.cell_watch import Follow

OWN_TAG = "requestedCells"
JOIN_TIMEOUT = 3.0
"""Seconds after which the interface is requested again."""
LOOK_EVERY = 1.0
"""Seconds between two checks of the connection."""


@dataclass(frozen=True, slots=True)
class WorldAccount:
    """The simulated world's user account at the engine.

    Attributes:
        url: URL of the master.
        user: User ID.
        password: The user's password.
        robot: The robotID with which the world connects.
    """

    url: str
    user: str
    password: str = field(repr=False)
    robot: str = "world"


class EngineCellWatch:
    """Watches the cells that people block through an interface of its container.

    The planner's container may start later than the world, or be restarted: the interface is requested until
    it is connected, and again when it is lost.

    Args:
        account: User and engine of the fleet.
        container: Tag of the planner's container.
    """

    def __init__(self, account: WorldAccount, container: str) -> None:
        self._account = account
        self._container = container
        self.joined = asyncio.Event()
        """Set once the interface was connected."""

    async def run(self, follow: Follow) -> None:
        """Watch until cancelled, then remove the interface.

        Args:
            follow: Called whenever the blocked cells or their grid change.

        Raises:
            RefusedError: The engine refused the client.
        """
        account = self._account

        def take(message: dict[str, Any]) -> None:
            labels = [str(each["label"]) for each in message["layout"]["dim"]]
            follow([int(cell) for cell in message["data"]], grid_of(labels))

        connection = Connection(
            account.url, account.user, account.password, account.robot, on_error=lambda _: None
        )
        async with connection:
            try:
                await connection.subscriber(OWN_TAG, CELLS, take)
                while True:
                    if not connection.active.get(OWN_TAG, False):
                        await self._join(connection)
                        self.joined.set()
                    await asyncio.sleep(LOOK_EVERY)
            finally:
                if connection.connected:
                    await connection.remove_all()

    async def _join(self, connection: Connection) -> None:
        tag = f"{OWN_TAG}_{connection.robot_id}"
        while True:
            await connection.add_interface(self._container, tag, "SubscriberInterface", CELLS, addr=TOPIC)
            await connection.connect(f"{connection.robot_id}/{OWN_TAG}", f"{self._container}/{tag}")
            try:
                await connection.wait_active(OWN_TAG, timeout=JOIN_TIMEOUT)
            except TimeoutError:
                continue
            return
