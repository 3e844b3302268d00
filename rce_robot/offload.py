"""An interface's conversions in other processes: requests and answers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from rce_robot.conversion import ConversionFailedError, ReadText, ReadValue, Result, Show
from rce_robot.exceptions import UnreadableError
from rce_robot.outgoing import Buffer, Outgoing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.model import InterfaceSpec
    from rce.protocol import LargeData
    from rce_robot.interface import RobotSide


class Read(NamedTuple):
    """The result of converting a message of the robot."""

    payload: Buffer | None = None
    """The serialized message; None if there is a fault, or if it was a string."""
    warnings: tuple[str, ...] = ()
    fault: str = ""
    msg_id: str = ""
    text: str | None = None
    """The message was a string: a service's error text."""
    ids: tuple[str, ...] = ()
    """Binary values that are still missing."""


class Offload:
    """Conversions of one interface in other processes.

    Args:
        robot: The way to the processes.
        spec: The interface.
    """

    def __init__(self, robot: RobotSide, spec: InterfaceSpec) -> None:
        self._robot = robot
        self._spec = spec

    async def read_text(self, large: LargeData) -> Read:
        """Parse and serialize a message from its text. Does not raise."""
        job = ReadText(
            i_tag=large.address.i_tag,
            stated_type=large.address.message_type,
            message_type=self._spec.message_type,
            interface_type=self._spec.type,
            ids=tuple(large.binaries),
        )
        return await self._read(job, (large.text, *large.binaries.values()))

    async def read_value(self, packed: bytes) -> Read:
        """Serialize a message that :func:`pack_value` packed. Does not raise."""
        return await self._read(
            ReadValue(message_type=self._spec.message_type, interface_type=self._spec.type), (packed,)
        )

    async def show(self, payload: Buffer, msg_id: str) -> Outgoing:
        """Make the data message that carries a payload to the robot.

        Raises:
            UnreadableError: It is not a message of the type, or cannot be converted.
        """
        spec = self._spec
        job = Show(i_tag=spec.tag, message_type=spec.message_type, interface_type=spec.type, msg_id=msg_id)
        try:
            result, parts = await self._robot.convert(job, (payload,))
        except ConversionFailedError as error:
            raise UnreadableError(str(error)) from error
        if result.fault:
            raise UnreadableError(result.fault)
        text, *binaries = parts
        return Outgoing(text, tuple((b"", binary) for binary in binaries))

    async def _read(self, job: ReadText | ReadValue, parts: Sequence[Buffer]) -> Read:
        try:
            result, payload = await self._robot.convert(job, parts)
        except ConversionFailedError as error:
            return Read(fault=str(error))
        return _understood(result, payload)


def _understood(result: Result, parts: list[memoryview]) -> Read:
    return Read(
        payload=parts[0] if parts else None,
        warnings=result.warnings,
        fault=result.fault,
        msg_id=result.msg_id,
        text=result.text,
        ids=result.ids,
    )


def pack_value(msg: Any) -> bytes:
    """Pack the content of a data message for :meth:`Offload.read_value`.

    Raises:
        UnreadableError: It holds an integer that is out of range for every message.
    """
    try:
        return msgspec.msgpack.encode(msg)
    except OverflowError as error:
        raise UnreadableError("an integer is longer than 64 bits") from error
