"""Reports of task sets to the master's state, and what they change."""

from __future__ import annotations

from rce.control.model import (
    EndpointState,
    EndpointStatus,
)
from rce_master.state.changes import Changes

MB = 1 << 20


def status(
    tag: str, state: EndpointState = EndpointState.RUNNING, revision: int = 1, **fields: object
) -> EndpointStatus:
    return EndpointStatus(id=f"anna/{tag}", revision=revision, state=state, **fields)  # type: ignore[arg-type]  # any of its fields


def kinds(changes: Changes) -> list[str]:
    return [h.kind for h in changes.events]
