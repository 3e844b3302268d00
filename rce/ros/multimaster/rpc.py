"""The RPC server of a discovery: plain XML-RPC, without the status that the methods of ROS answer with."""

from __future__ import annotations

import getpass
import inspect
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rce.ros.errors import MalformedDocumentError
from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.heartbeat import ZERO
from rce.ros.multimaster.state import MasterInfo, stamp_text
from rce.ros.xmlrpc.codec import decode_call, encode_fault, encode_response
from rce.ros.xmlrpc.dispatch import Dispatcher

_log = logging.getLogger(__name__)

_FAULT = 1
MAX_TYPES = 1000
"""For how many types checksums may be asked at once."""

PlainMethod = Callable[..., Any]


class PlainDispatcher(Dispatcher):
    """Answers with the methods' return values; exceptions are answered as faults."""

    def __init__(self, methods: Mapping[str, PlainMethod]) -> None:
        super().__init__({})
        self._plain = dict(methods)

    def respond(self, document: bytes) -> bytes:
        """Answer the call in ``document``. Never raises."""
        try:
            method, arguments = decode_call(document)
            return encode_response(self._answer(method, arguments))
        except Exception as error:  # noqa: BLE001 - the caller gets every failure
            if not isinstance(error, MalformedDocumentError | _RefusedError):
                _log.exception("a call of the discovery failed")
            return encode_fault(_FAULT, f"{type(error).__name__}: {error}")

    def _answer(self, method: str, arguments: Sequence[Any]) -> Any:
        if method == "system.listMethods":
            return sorted([*self._plain, "system.listMethods"])
        handler = self._plain.get(method)
        if handler is None:
            raise _RefusedError(f"there is no method {method!r}")
        try:
            inspect.signature(handler).bind(*arguments)
        except TypeError as error:
            raise _RefusedError(f"{method}: {error}") from error
        return handler(*arguments)


class _RefusedError(Exception):
    """A mistake of the caller."""


@dataclass(slots=True)
class DiscoveryApi:
    """The methods that other discoveries, synchronizations and fkie's tools call on a discovery."""

    uri: str
    """The master's URI."""
    name: str
    """The master's name."""
    node: str
    """The discovery node's name."""
    monitor_uri: Callable[[], str]
    info: Callable[[], MasterInfo | None]
    md5sum: Callable[[str], str | None]
    """Returns the checksum of a message type, None if the type is not known."""

    def methods(self) -> dict[str, PlainMethod]:
        """Return the method table."""
        return {
            "masterInfo": self._master_info,
            "masterInfoFiltered": self._master_info_filtered,
            "masterContacts": self._master_contacts,
            "masterErrors": lambda: [self.uri, []],
            "getCurrentTime": lambda: [self.uri, time.time()],
            "setTime": self._set_time,
            "getTopicsMd5sum": self._get_topics_md5sum,
            "getUser": lambda: [self.uri, getpass.getuser()],
        }

    def _master_info(self) -> list[Any]:
        return self._known().to_wire()

    def _master_info_filtered(self, filters: Any) -> list[Any]:
        if not isinstance(filters, list):
            raise _RefusedError("a filter is a list of a boolean and ten expressions")
        return self._known().filtered(SyncFilter.from_wire(filters)).to_wire()

    def _master_contacts(self) -> list[str]:
        info = self.info()
        stamp = info.stamp if info is not None else ZERO
        return [stamp_text(stamp), self.uri, self.name, self.node, self.monitor_uri()]

    def _set_time(self, _timestamp: Any) -> list[Any]:
        return [self.uri, False, time.time(), "this discovery does not set the machine's clock"]

    def _get_topics_md5sum(self, types: Any) -> list[list[str]]:
        if not isinstance(types, list):
            raise _RefusedError("a list of message types is needed")
        asked = dict.fromkeys(kind for kind in types if isinstance(kind, str))
        if len(asked) > MAX_TYPES:
            raise _RefusedError(f"at most {MAX_TYPES} message types are answered at once, not {len(asked)}")
        pairs = [(kind, self.md5sum(kind)) for kind in asked]
        return [[kind, md5sum] for kind, md5sum in pairs if md5sum is not None]

    def _known(self) -> MasterInfo:
        info = self.info()
        if info is None:
            raise _RefusedError("the master's state is not known yet")
        return info
