"""Requests of robots that the master carries out, and the reports to a robot about what it refused."""

from __future__ import annotations

from itertools import repeat
from typing import Protocol

from rce.control import (
    ClientReply,
    ControlError,
    LoginReply,
    MasterUnavailableError,
    RequestFault,
    ToMaster,
)
from rce.model import EndpointId, FaultCode, Request
from rce.protocol import ErrorReport, type_of, write_request

_NO_FAULT = RequestFault()
_CODES = {code.value: code for code in FaultCode}
_KEYS = {
    "container": "containerTag",
    "node": "nodeTag",
    "parameter": "name",
    "endpoint": "endpointTag",
    "interface": "interfaceTag",
    "a": "tagA",
    "b": "tagB",
}
"""The client protocol's keys for what a request is about."""


class MasterChannel(Protocol):
    """The used part of :class:`rce.control_channel.channel.TaskSetChannel`."""

    def send(self, message: ToMaster) -> None:
        """Send, or drop while the master is away."""

    async def login(
        self, user: str, robot: str, password: str, address: str = "", token: str = ""
    ) -> LoginReply:
        """Ask whether a robot may log in; raise :class:`ControlError` if the master stays away."""

    async def client_request(
        self,
        id: str,  # noqa: A002 - wire names
        type: str,  # noqa: A002
        data: object = None,
        *,
        content: Request | None = None,
    ) -> ClientReply:
        """Have a client's request carried out; raise :class:`ControlError` likewise."""


async def ask_master(
    channel: MasterChannel, id_: EndpointId, request: Request, *, typed: bool
) -> tuple[ErrorReport, ...]:
    """Have a robot's request carried out; return the faults.

    Args:
        channel: The channel to the master.
        id_: The robot.
        request: Its request.
        typed: Whether the master takes typed requests; a master of the release before takes a document.
    """
    type_ = type_of(request)
    try:
        if typed:
            reply = await channel.client_request(str(id_), type_, content=request)
        else:
            reply = await channel.client_request(str(id_), type_, data=write_request(request))
    except MasterUnavailableError as error:
        # It was sent, and only its answer is missing: a client that repeats it gets it done for certain.
        problem = f"{type_}: it is not known whether it was done: {error}"
        return (ErrorReport(problem=problem, code=FaultCode.BUSY),)
    except ControlError as error:
        return (ErrorReport(problem=f"{type_}: not done: {error}"),)
    return reports_of(reply)


def reports_of(reply: ClientReply) -> tuple[ErrorReport, ...]:
    """Return a report for each error of a reply; a master of the release before gives texts only.

    Codes and keys that only a later release knows are left out.
    """
    faults = (*reply.faults, *repeat(_NO_FAULT, len(reply.errors) - len(reply.faults)))
    return tuple(
        ErrorReport(
            problem=problem,
            code=_CODES.get(fault.code),
            ids={_KEYS[key]: value for key, value in fault.ids.items() if key in _KEYS},
        )
        for problem, fault in zip(reply.errors, faults, strict=False)
    )
