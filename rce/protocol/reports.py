"""The form of an ``ER``: a text for users, and the same as data for programs.

::

    {"type": "ER", "data": "ask, msgID call7: no answer within 30 s",
     "fault": {"iTag": "ask", "msgID": "call7"}}

Engines of the release before send the text only, and clients of it read the text only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.model import FaultCode
from rce.protocol.calls import call_at
from rce.protocol.messages import ErrorReport

if TYPE_CHECKING:
    from rce.model import Path


def write_report(report: ErrorReport) -> dict[str, Any]:
    """Write the whole message."""
    fault: dict[str, Any] = {}
    if report.code is not None:
        fault |= {"code": report.code.value, "path": list(report.path)}
    if report.call is not None:
        fault |= {"iTag": report.call.i_tag, "msgID": report.call.msg_id}
    return {"type": "ER", "data": report.text, **({"fault": fault} if fault else {})}


def read_report(text: str, fault: Any) -> ErrorReport:
    """Read a message.

    Args:
        text: Its ``data``.
        fault: Its ``fault``; unknown parts of it are left out.
    """
    if not isinstance(fault, dict):
        return ErrorReport(problem=text)
    call = call_at(fault.get("iTag"), fault.get("msgID"))
    known = fault.get("code") in [code.value for code in FaultCode]
    return ErrorReport(
        problem=text if call is None else text.removeprefix(f"{call}: "),
        call=call,
        path=_read_path(fault.get("path")) if known else (),
        code=FaultCode(fault["code"]) if known else None,
    )


def _read_path(steps: Any) -> Path:
    good = isinstance(steps, list) and all(type(step) in (str, int) for step in steps)
    return tuple(steps) if good else ()
