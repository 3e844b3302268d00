"""The client of the fleet's HTTP API."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rce_fleet.client.floor import FloorRequests
from rce_fleet.client.history import HistoryRequests
from rce_fleet.client.robots import RobotRequests
from rce_fleet.client.tasks import TaskRequests


class FleetClient(TaskRequests, RobotRequests, FloorRequests, HistoryRequests):
    """Tasks, robots, zones and events of a fleet. Use it as an asynchronous context manager.

    Requests that can be repeated are sent again, with growing pauses, while the station or the fleet manager
    cannot be reached: all that read, all that name a state (a goal, a blocked cell, a hold), and the creation
    of tasks, which has a key. Changes with a ``revision`` are sent once.

    Methods raise :class:`~rce_fleet.client.errors.ApiError` if a request was refused,
    :class:`~rce_fleet.client.errors.OutdatedError` if the revision is not the newest one, and
    :class:`~rce_fleet.client.errors.FleetApiUnavailableError` if there is no answer. Cancelling does not
    withdraw a request.

    Args:
        url: URL of the station.
        token: Bearer token of a user of the engine (``rce token``); empty for a station without logins.
        tls: Checks the station's certificate; None for the authorities that the system trusts.
        attempts: How often a request is sent that can be repeated.

    Raises:
        ValueError: The URL cannot be that of a station.
    """

    async def __aenter__(self) -> Self:
        await self._transport.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._transport.close()
