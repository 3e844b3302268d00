"""Interfaces of a robot, with a robot and ports that live in the test."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Collection, Coroutine, Sequence
from typing import Any

from rce.aio.queues import OverflowPolicy
from rce.guard.holdings import Holding, Holdings
from rce.link import (
    Buffer,
)
from rce.model.names import InterfaceType
from rce.model.specs import InterfaceSpec
from rce.protocol.messages import CallId, DataMessage, ErrorReport
from rce.protocol.stream import LargeData
from rce.ros.types import TypeRegistry
from rce_robot.conversion import Result
from rce_robot.conversion.jobs import HEAD, Job, decode_job, pack
from rce_robot.conversion.worker import Worker
from rce_robot.doors.base import Queued
from rce_robot.factory import FormFactory
from rce_robot.interface import RobotInterface
from rce_robot.interfaces import make_interface
from rce_robot.outgoing import Outgoing, Rendered

STRING = "std_msgs/String"


SERVICE = "std_srvs/SetBool"


WORKER = Worker(FormFactory(TypeRegistry()), 1 << 30)


class FakePort:
    def __init__(self, type_: str, cls: str, queue_size: int = 0) -> None:
        self.spec = InterfaceSpec(tag="tag", type=type_, message_type=cls, queue_size=queue_size)
        self.sent: list[bytes] = []
        self.latched: dict[str, bytes] = {}
        self.answer: bytes | Exception | asyncio.Future[bytes] = b""

    def send(self, payload: Buffer, *, latched: bool = False, source: str = "") -> None:
        self.sent.append(bytes(payload))
        if latched:
            self.latched[source] = bytes(payload)

    def keep_latched(self, sources: Collection[str]) -> None:
        self.latched = {source: self.latched[source] for source in sources if source in self.latched}

    async def call(self, payload: Buffer, *, timeout: float | None = None) -> bytes:
        self.sent.append(bytes(payload))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer if isinstance(self.answer, bytes) else await self.answer


class FakeRobot:
    def __init__(self) -> None:
        self.connected = True
        self.room = True
        self.data: list[tuple[Rendered, OverflowPolicy]] = []
        self.queue_sizes: list[int] = []
        self.urgent: list[Rendered] = []
        self.reports: list[str] = []
        self.states: list[bool] = []
        self.dropped = 0
        self.work: list[asyncio.Task[None]] = []
        self.gone: list[RobotInterface] = []
        self.holdings = Holdings()
        self.latched_dropped = 0
        self.knows_sources = True
        self.sources: list[tuple[str, ...]] = []
        self.awaited: list[tuple[LargeData, list[str]]] = []
        self.binaries: dict[str, memoryview] = {}
        """Binary values that came before they were asked for."""
        self.converting: Callable[[], Awaitable[object]] = lambda: asyncio.sleep(0)
        """What a conversion waits for."""

    def send_data(self, tag: str, message: Queued, overflow: OverflowPolicy, queue_size: int = 0) -> bool:
        rendered = message.render()
        self.queue_sizes.append(queue_size)
        if rendered is not None and self.room:
            self.data.append((rendered, overflow))
        return self.room

    def send_urgent(self, message: Queued) -> bool:
        rendered = message.render()
        if rendered is not None and self.room:
            self.urgent.append(rendered)
        return self.room

    def report(self, problem: str, call: CallId | None = None) -> None:
        self.reports.append(ErrorReport(problem=problem, call=call).text)

    def show_active(self, tag: str, active: bool) -> None:
        self.states.append(active)

    def send_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        self.send_data(tag, message, OverflowPolicy.DROP_OLDEST)

    def send_sources(self, tag: str, sources: Sequence[str]) -> None:
        self.sources.append(tuple(sources))

    def drop_latched(self, tag: str, source: str) -> None:
        self.latched_dropped += 1

    def hold(self, size: int, give_up: Callable[[], object] | None = None) -> Holding:
        return self.holdings.hold(size, give_up)

    async def convert(self, job: Job, parts: Sequence[Any]) -> tuple[Result, list[memoryview]]:
        """Do in this process what a worker process does, after :attr:`converting`."""
        await self.converting()
        described, *rest = pack(job, parts)
        result, made = WORKER.do(
            decode_job(described[HEAD.size + 8 * (len(parts) + 1) :]), list(map(bytes, rest))
        )
        return result, [memoryview(part) for part in made]

    def await_binaries(self, large: LargeData, ids: Sequence[str]) -> LargeData | None:
        self.awaited.append((large, list(ids)))
        if not self.binaries:
            return None
        return LargeData(large.address, large.text, {id_: self.binaries[id_] for id_ in ids})

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        if self.room:
            self.work.append(asyncio.ensure_future(work))
        else:
            work.close()
        return self.room

    def count_dropped(self, tag: str) -> None:
        self.dropped += 1

    def closed(self, interface: RobotInterface) -> None:
        self.gone.append(interface)


class Setup:
    def __init__(self, type_: str, cls: str = STRING, call_timeout: float = 5.0, queue_size: int = 0) -> None:
        self.port = FakePort(type_, cls, queue_size)
        self.robot = FakeRobot()
        kind = InterfaceType.parse(type_)
        forms = FormFactory(TypeRegistry()).pair(self.port.spec, kind)
        self.interface = make_interface(kind.role, self.port, self.robot, *forms, call_timeout=call_timeout)

    def take(self, msg: object, msg_id: str = "nil") -> None:
        self.interface.take(
            DataMessage(i_tag="tag", message_type=self.port.spec.message_type, msg=msg, msg_id=msg_id)
        )


def shown(message: Rendered) -> Any:
    assert isinstance(message, Outgoing)
    return json.loads(bytes(message.text))["data"]


def ros_string(text: str) -> bytes:
    return len(text).to_bytes(4, "little") + text.encode()
