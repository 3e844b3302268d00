"""The file ``/etc/hosts`` of a container. Pure."""

from __future__ import annotations

from collections.abc import Iterable

MAX_HOSTNAME = 63


def hostname(tag: str) -> str:
    """Return the host name of the container with this tag."""
    return tag[:MAX_HOSTNAME]


def hosts_text(tag: str, members: Iterable[tuple[str, str]] = ()) -> str:
    """Return the contents of the file.

    Args:
        tag: The container's.
        members: Tag and address of each container of its group, itself included; empty without a group.
    """
    lines = [f"{address} {hostname(name)}" for name, address in sorted(members)]
    own = "" if lines else f" {hostname(tag)}"
    return "\n".join([f"127.0.0.1 localhost{own}", *lines, ""])
