"""Keeps a node registered at its master: registers everything again after the master lost its state.

A restarted master knows no nodes. A node notices a restart by a connection that it keeps open to the master
for this purpose, and by asking periodically whether the master still knows it; the parameter ``/run_id``
identifies one run of a core.
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rce.aio.backoff import Backoff
from rce.aio.tasks import run_in_groups
from rce.ros.errors import MasterError, MasterRefusedError, MasterUnreachableError, RpcUnreachableError
from rce.ros.node.master import MasterClient
from rce.ros.node.parameters import Parameters
from rce.ros.node.service import Service
from rce.ros.node.topic_input import TopicInput
from rce.ros.node.topics import Topics

_log = logging.getLogger(__name__)

CHECK_INTERVAL = 30.0
"""Seconds after which the master is asked whether it knows the node, although no connection was lost."""

RETRY = Backoff(first=0.1, longest=3.0, jitter=0.5)
"""Pauses between attempts to reach a master that is away."""

REGISTERED_AT_ONCE = 500
"""How many topics and services are registered side by side, in requests of several."""

RUN_ID = "/run_id"


@dataclass(slots=True)
class Registrar:
    """Keeps one node registered."""

    master: MasterClient
    topics: Topics
    services: dict[str, Service]
    parameters: Parameters
    service_uri: str
    private_parameters: dict[str, Any]
    """Parameters that the command line set, by global name."""
    on_displaced: Callable[[str], None]
    """Takes the reason when another node has this one's name."""
    _run_id: Any = field(default=None, init=False)

    async def register_all(self) -> None:
        """Register all topics, services and parameters of the node at the master.

        Raises:
            MasterError: The registration at the master failed.
        """
        topics = self.topics
        works = [
            partial(self._publish, topic, output.message_type_name)
            for topic, output in topics.outputs.items()
        ]
        works += [partial(self._subscribe, topic, source) for topic, source in topics.inputs.items()]
        works += [partial(self._provide, name) for name in self.services]
        await run_in_groups(works, REGISTERED_AT_ONCE)
        await self.parameters.renew()

    async def _publish(self, topic: str, message_type: str) -> None:
        await self.master.register_publisher(topic, message_type)
        if topic not in self.topics.outputs:  # closed meanwhile
            await self.master.unregister_publisher(topic)

    async def _subscribe(self, topic: str, source: TopicInput) -> None:
        await source.register()
        if self.topics.inputs.get(topic) is not source:
            await self.master.unregister_subscriber(topic)

    async def _provide(self, name: str) -> None:
        await self.master.register_service(name, self.service_uri)
        if name not in self.services:
            await self.master.unregister_service(name, self.service_uri)

    async def keep(self) -> None:
        """Watch the master for as long as the node runs."""
        await self._until_reached(self._remember_run)
        while True:
            was_lost = await self._until_in_doubt()
            await self._until_reached(lambda was_lost=was_lost: self._check(was_lost=was_lost))  # type: ignore[misc]

    async def _until_in_doubt(self) -> bool:
        """Wait until the next check is due; return whether the connection to the master was lost."""
        try:
            async with asyncio.timeout(CHECK_INTERVAL * random.uniform(0.75, 1.25)):  # noqa: S311 - no key
                await self.master.rpc.until_lost(self.master.uri)
        except TimeoutError:
            return False
        except RpcUnreachableError as error:
            _log.debug("%s", error)
        return True

    async def _until_reached(self, attempt: Callable[[], Awaitable[None]]) -> None:
        pauses = RETRY.start()
        while True:
            try:
                await attempt()
            except MasterUnreachableError as error:
                _log.debug("%s; trying again", error)
            except MasterError as error:
                _log.warning("%s does not take %s back: %s", self.master.uri, self.master.caller, error)
            else:
                return
            await asyncio.sleep(pauses.next())

    async def _check(self, *, was_lost: bool) -> None:
        master = self.master
        uri = await master.lookup_node(master.caller)
        if uri not in (None, master.slave_uri):
            self.on_displaced(f"another node at {uri} has its name")
            return
        run_id = await self._ask_run_id()
        if was_lost or uri is None or run_id != self._run_id:
            if run_id != self._run_id:
                _log.info("%s is another core now: %s registers again", master.uri, master.caller)
                for name, value in self.private_parameters.items():
                    await self.parameters.set(name, value)
            await self.register_all()
            self._run_id = run_id

    async def _remember_run(self) -> None:
        self._run_id = await self._ask_run_id()

    async def _ask_run_id(self) -> Any:
        try:
            return await self.master.call("getParam", RUN_ID)
        except MasterRefusedError:
            return None  # a bare rosmaster has none
