"""The errors of etcd.

::

    StoreError
    +-- EtcdError
        +-- EtcdRefusedError     etcd refused a request and did nothing
        +-- EtcdAwayError        no member of etcd answered
        +-- NoQuorumError        members answer, but too few for a majority
"""

from __future__ import annotations

from collections.abc import Sequence

from rce_master.exceptions import StoreError
from rce_master.store.etcd.wire import GatewayFault

OUT_OF_RANGE = 11
"""gRPC's code for a revision that was compacted away."""
NOT_FOUND = 5
_INVALID, _EXHAUSTED, _DENIED, _NOT_AUTHENTICATED = 3, 8, 7, 16
_TOO_LARGE = ("too large", "larger than max", "too many operations")
_LARGER = "start etcd with --max-request-bytes 16777216"
_MAKE_ROOM = (
    "its database is full: compact and defragment it, or start etcd with a greater --quota-backend-bytes,"
    " then run: etcdctl alarm disarm"
)
NO_SPACE_ALARM = "NOSPACE"
"""Of an etcd that takes no writes and no leases until the alarm is disarmed."""
NO_SPACE = f"etcd refuses all writes: database space exceeded; {_MAKE_ROOM}"
_HINTS = {
    "too large": _LARGER,
    "larger than max": _LARGER,
    "too many operations": "start etcd with --max-txn-ops 4096",
    "space exceeded": _MAKE_ROOM,
}
_CERTIFICATE_HINT = "etcd asks for a login or a certificate that this master does not have"


QUORUM = (
    "more than half of the members of etcd must run and reach each other, which 'rce cluster status' shows;"
    " if they are lost for good: rce cluster recover (docs/how-to/cluster.md), or restore a backup to a new"
    " etcd"
)


def with_remedy(error: StoreError) -> str:
    """Return the text of an error; if etcd does not answer, with what the operator can do."""
    return f"{error}; {QUORUM}" if isinstance(error, EtcdAwayError) else str(error)


class EtcdError(StoreError):
    """A request to etcd failed."""


class EtcdRefusedError(EtcdError):
    """Etcd refused a request; it did nothing.

    Attributes:
        fault: etcd's error.
    """

    def __init__(self, endpoint: str, fault: GatewayFault) -> None:
        super().__init__(endpoint, fault)
        self.endpoint = endpoint
        self.fault = fault

    @property
    def is_too_large(self) -> bool:
        """Whether a smaller request may be done."""
        return any(part in self.fault.text for part in _TOO_LARGE)

    def __str__(self) -> str:
        text = self.fault.text.removeprefix("etcdserver: ").removeprefix("mvcc: ")
        hint = next((hint for part, hint in _HINTS.items() if part in text), "")
        if not hint and self.fault.code in (_DENIED, _NOT_AUTHENTICATED):
            hint = _CERTIFICATE_HINT
        return f"etcd at {self.endpoint} refused: {text}" + (f"; {hint}" if hint else "")


class NoQuorumError(EtcdError):
    """Members of etcd answer, but too few for a majority."""


class EtcdAwayError(EtcdError):
    """No member of etcd answered, or all of them had no leader.

    Attributes:
        maybe_done: Whether the request may have been done, or may still be done later.
        reasons: What happened at each endpoint.
    """

    def __init__(self, reasons: Sequence[str], *, maybe_done: bool) -> None:
        super().__init__(tuple(reasons), maybe_done)
        self.reasons = tuple(reasons)
        self.maybe_done = maybe_done

    def __str__(self) -> str:
        return "etcd does not answer: " + "; ".join(self.reasons)
