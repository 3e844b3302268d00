"""A typed client of the fleet's HTTP API: tasks, robots, zones, events.

Example:
    ```python
    async with FleetClient("http://127.0.0.1:9080", token) as fleet:
        task = await fleet.create_task(TaskRequest(stops=[StopModel(cell=42)]))
        async for event in fleet.events():
            print(event.text)
    ```
"""

from rce_fleet.client.client import FleetClient
from rce_fleet.client.errors import ApiError, FleetApiUnavailableError, NotFoundError, OutdatedError
from rce_fleet.exceptions import EventsForgottenError, EventsRestartedError

__all__ = [
    "ApiError",
    "EventsForgottenError",
    "EventsRestartedError",
    "FleetApiUnavailableError",
    "FleetClient",
    "NotFoundError",
    "OutdatedError",
]
