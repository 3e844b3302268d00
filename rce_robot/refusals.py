"""Reports to a robot about the parts of a request that the master refused. Pure."""

from __future__ import annotations

from itertools import repeat
from typing import TYPE_CHECKING

from rce.control.messages import RequestFault
from rce.model import FaultCode
from rce.protocol.messages import ErrorReport

if TYPE_CHECKING:
    from rce.control.messages import ClientReply

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
