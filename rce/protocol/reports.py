"""The form of an ``ER``: a text for users, and the same as data for programs.

::

    {"type": "ER", "data": "ask, msgID call7: no answer within 30 s",
     "fault": {"iTag": "ask", "msgID": "call7"}}
    {"type": "ER", "data": "DC: there is no container 'brain'; create it first",
     "fault": {"code": "not_found", "path": [], "ids": {"containerTag": "brain"}}}

Engines of the release before send the text only, and clients of it read the text only.
"""

from __future__ import annotations

from typing import Any

from rce.model import FaultCode, FieldFault, Path
from rce.protocol.calls import call_at
from rce.protocol.messages import ErrorReport


def write_report(report: ErrorReport) -> dict[str, Any]:
    """Write the whole message."""
    fault: dict[str, Any] = {}
    if report.code is not None:
        fault |= {"code": report.code.value, "path": list(report.path)}
    if report.faults:
        fault["faults"] = [
            {"code": one.code.value, "path": list(one.path), "problem": one.problem} for one in report.faults
        ]
    if report.ids:
        fault["ids"] = report.ids
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
    code = _read_code(fault)
    return ErrorReport(
        problem=text if call is None else text.removeprefix(f"{call}: "),
        call=call,
        path=_read_path(fault.get("path")) if code is not None else (),
        code=code,
        faults=_read_faults(fault.get("faults")),
        ids=_read_ids(fault.get("ids")),
    )


def _read_code(fault: dict[str, Any]) -> FaultCode | None:
    found = fault.get("code")
    return next((code for code in FaultCode if code.value == found), None)


def _read_faults(items: Any) -> tuple[FieldFault, ...]:
    if not isinstance(items, list):
        return ()
    faults = []
    for item in items:
        code = _read_code(item) if isinstance(item, dict) else None
        if code is not None:
            problem = item.get("problem")
            faults.append(
                FieldFault(_read_path(item.get("path")), code, problem if isinstance(problem, str) else "")
            )
    return tuple(faults)


def _read_ids(ids: Any) -> dict[str, str]:
    if not isinstance(ids, dict):
        return {}
    return {key: value for key, value in ids.items() if isinstance(key, str) and isinstance(value, str)}


def _read_path(steps: Any) -> Path:
    good = isinstance(steps, list) and all(type(step) in (str, int) for step in steps)
    return tuple(steps) if good else ()
