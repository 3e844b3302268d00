"""Checks of arguments that the Master API and the Slave API share. Pure."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

from rce.ros import names
from rce.ros.xmlrpc.dispatch import BadArgumentError


def graph_name(role: str, value: Any, caller: str) -> str:
    """Check a topic, service or node name and make it global.

    Only impossible names are refused: real nodes use names that the written rules do not allow.

    Args:
        role: The parameter's name, for errors.
        value: What was sent.
        caller: The caller's name, below which private names are.

    Raises:
        BadArgumentError: It is not a name.
    """
    if not isinstance(value, str) or not value:
        raise BadArgumentError(f"parameter [{role}] must be a non-empty string")
    if ":" in value or any(character.isspace() for character in value):
        raise BadArgumentError(f"parameter [{role}] contains illegal characters: {value!r}")
    resolved = names.resolve(value, caller)
    if resolved == names.SEPARATOR:
        raise BadArgumentError(f"parameter [{role}] cannot be the global namespace")
    return resolved


def node_uris(role: str, value: Any) -> list[str]:
    """Check a list of slave APIs.

    Args:
        role: The parameter's name, for errors.
        value: What was sent.

    Raises:
        BadArgumentError: It is not a list, or an entry is not a URI with a scheme and a host.
    """
    if not isinstance(value, list):
        raise BadArgumentError(f"parameter [{role}] must be a list of URIs of the form http://host:port/")
    for entry in value:
        if not _has_scheme_and_host(entry):
            raise BadArgumentError(
                f"parameter [{role}] holds {entry!r}, which is not a URI of the form http://host:port/"
            )
    return value


def _has_scheme_and_host(entry: Any) -> bool:
    if not isinstance(entry, str):
        return False
    try:
        parts = urlsplit(entry)
    except ValueError:
        return False
    return bool(parts.scheme and parts.netloc)
