"""The robot's end of topics, in both directions."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from rce.aio.queues import OverflowPolicy
from rce.protocol import NO_ID, DataMessage, LargeData
from rce_robot.conversion import ConversionQueue
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.interface import Delivery, RobotInterface, RobotSide
from rce_robot.offload import Read
from rce_robot.outgoing import Buffer, Outgoing

if TYPE_CHECKING:
    from collections.abc import Collection, Coroutine, Sequence

    from rce.guard import Holding
    from rce.link import Port
    from rce_robot.doors.base import Queued
    from rce_robot.forms import Form


_SOURCES = ""
"""The key of the sources that remain; no source has this name."""
_TOO_FAST = "messages come faster than they can be converted; one was dropped"


class _Converted(NamedTuple):
    """A converted message of the robot, or the sources that remain."""

    read: Read = Read()
    msg_id: str = NO_ID
    latch: str = ""
    sources: Sequence[str] | None = None


class FromRobot(RobotInterface):
    """Subscriber: sends the robot's messages to every peer.

    Its latched messages stay while it is away, for peers that connect later.
    """

    def __init__(self, port: Port, robot: RobotSide, form_in: Form, form_out: Form) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._queue = ConversionQueue[_Converted](robot, self._send, self._dropped)

    def take(self, message: DataMessage) -> None:
        """Send the message to the peers."""
        if not (self.form_in.costly or self._queue.busy):
            self._pass_on(self._read(message, self._warn), message.latch)
            return
        packed = self._pack(message)
        work = partial(self._convert_value, packed, message.msg_id, message.latch)
        self._put(len(packed), work, message.latch)

    def take_large(self, large: LargeData) -> None:
        """Send the message after its conversion; later messages wait for it."""
        self._put(large.size, partial(self._convert_text, large), large.address.latch)

    def keep_latched(self, sources: Sequence[str]) -> None:
        """End other sources, after the messages that wait to be converted."""
        if self._queue.busy:
            if not self._queue.put(0, partial(self._note_sources, sources), _SOURCES):
                self.robot.report(f"{self.tag}: {_TOO_FAST}")
        else:
            self.port.keep_latched(sources)

    def robot_joined(self) -> None:
        """Keep latched messages only if the robot names their sources."""
        super().robot_joined()
        if not self.robot.knows_sources:
            self.port.keep_latched(())

    def robot_left(self) -> None:
        """Forget what waits to be converted."""
        self._queue.clear()

    def _put(self, size: int, work: partial[Coroutine[Any, Any, _Converted]], latch: str) -> None:
        if not self._queue.put(size, work, latch or None):
            raise BusyError(f"{self.tag}: {_TOO_FAST}")

    async def _convert_value(self, packed: bytes, msg_id: str, latch: str) -> _Converted:
        return _Converted(await self.offload.read_value(packed), msg_id, latch)

    async def _convert_text(self, large: LargeData) -> _Converted:
        read = await self.read_large(large)
        return _Converted(read, read.msg_id or large.address.msg_id, large.address.latch)

    async def _note_sources(self, sources: Sequence[str]) -> _Converted:
        return _Converted(sources=sources)

    def _send(self, converted: _Converted) -> None:
        read = converted.read
        if read.fault or read.text is not None:
            problem = read.fault or "a string is not an object of the fields of the message"
            self._report(problem, converted.msg_id)
        for warning in read.warnings:
            self._warn(warning)
        if read.payload is not None:
            self._pass_on(read.payload, converted.latch)
        if converted.sources is not None:
            self.port.keep_latched(converted.sources)

    def _pass_on(self, payload: Buffer, latch: str) -> None:
        if latch:
            self.port.send(payload, latched=True, source=latch)
        else:
            self.port.send(payload)

    def _dropped(self) -> None:
        self.robot.report(f"{self.tag}: memory is short; a message that waited to be converted was dropped")


class ToRobot(RobotInterface):
    """Publisher: sends the peers' messages to the robot.

    The last latched message of each source is kept, and sent again to a robot that comes back, as a latched
    topic does for every new subscriber. Other messages that arrive while the robot is away are dropped.
    """

    def __init__(self, port: Port, robot: RobotSide, form_in: Form, form_out: Form) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._latched: dict[str, _Kept] = {}
        self._queue = ConversionQueue[tuple[Outgoing | None, str, str]](
            robot, self._send_shown, self._dropped
        )

    async def start(self) -> None:
        """Tell the robot that no message is latched here yet, in place of a former interface's statement."""
        self.robot.send_sources(self.tag, ())

    def take(self, message: DataMessage) -> None:
        """Refuse the message."""
        raise MisdirectedError.at(self.tag, message.msg_id, "the interface takes nothing from the robot")

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Send a peer's message to the robot."""
        if latched:
            self.receive_latched(payload, "0")
        else:
            self._send(payload, "")

    def receive_latched(self, payload: bytes, source: str) -> None:
        """Send a peer's message to the robot, and keep it."""
        self._forget(source)
        kept = self._latched[source] = _Kept(payload)
        holding = self.robot.hold(len(payload), partial(self._give_up, source, kept))
        if self._latched.get(source) is kept:  # else it was given up at once
            kept.holding = holding
        self._send(payload, source)

    def unlatch(self, sources: Collection[str]) -> None:
        """Drop the latched messages of ended sources."""
        for source in sources:
            self._forget(source)
        self.robot.send_sources(self.tag, tuple(self._latched))

    def robot_joined(self) -> None:
        """Also send the last latched messages."""
        super().robot_joined()
        for source, kept in list(self._latched.items()):
            self._send(kept.payload, source)
        self.robot.send_sources(self.tag, tuple(self._latched))

    def robot_left(self) -> None:
        """Forget what waits to be converted."""
        self._queue.clear()

    async def close(self) -> None:
        """Drop the latched messages too."""
        await super().close()
        for source in list(self._latched):
            self._forget(source)

    def _forget(self, source: str) -> None:
        kept = self._latched.pop(source, None)
        if kept is not None and kept.holding is not None:
            kept.holding.release()
            self._queue.count(source)

    def _give_up(self, source: str, kept: _Kept) -> None:
        """Drop the message because memory is short, and report it to the robot's user."""
        if self._latched.get(source) is kept:
            del self._latched[source]
        self._queue.drop(source)
        self.robot.drop_latched(self.tag, source)
        self.robot.count_dropped(self.tag)
        self.robot.report(f"{self.tag}: memory is short; the latched message was dropped")

    def _send(self, payload: bytes, source: str) -> None:
        if self._queue.busy or self.form_out.is_heavy(payload):
            key = source if source in self._latched else None  # which counts its bytes
            work = partial(self._show, payload, source)
            if self.robot.connected and not self._queue.put(len(payload), work, key, shared=key is not None):
                self.robot.count_dropped(self.tag)
        elif source in self._latched:
            self.robot.send_latched(self.tag, source, Delivery(self, payload, NO_ID), shared=True)
        else:
            self._send_newest(Delivery(self, payload, NO_ID))

    async def _show(self, payload: bytes, source: str) -> tuple[Outgoing | None, str, str]:
        try:
            return await self.offload.show(payload, NO_ID), "", source
        except UnreadableError as error:
            return None, str(error), source

    def _send_shown(self, converted: tuple[Outgoing | None, str, str]) -> None:
        outgoing, problem, source = converted
        if outgoing is None:
            self.not_rendered(NO_ID, problem)
        elif source in self._latched:
            self.robot.send_latched(self.tag, source, outgoing, shared=False)
        else:
            self._send_newest(outgoing)

    def _send_newest(self, message: Queued) -> None:
        """Send a message; older ones make room for it where the interface's queue is full."""
        self.robot.send_data(self.tag, message, OverflowPolicy.DROP_OLDEST, self.port.spec.queue_size)

    def _dropped(self) -> None:
        self.robot.count_dropped(self.tag)


class _Kept:
    """The latched message of a source."""

    __slots__ = ("holding", "payload")

    def __init__(self, payload: bytes) -> None:
        self.payload = payload
        self.holding: Holding | None = None
