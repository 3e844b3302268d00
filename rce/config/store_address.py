"""Where the master keeps its state: ``sqlite:PATH`` or ``etcd://HOST:PORT,...``. Pure."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

SQLITE = "sqlite:"
ETCD_PORT = 2379
DEFAULT_PREFIX = "/rce"
_ETCD = re.compile(r"(etcds?)://([^/]*)(/.*)?", re.ASCII)
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?", re.ASCII)
_PREFIX = re.compile(r"(?:/[A-Za-z0-9._-]+)+", re.ASCII)
_MAX_PORT = 65535


@dataclass(frozen=True, slots=True)
class SqliteAddress:
    """A state folder on this machine."""

    folder: Path | None = None
    """None: the default one."""


@dataclass(frozen=True, slots=True)
class EtcdAddress:
    """Members of an etcd, and where in it the state is."""

    endpoints: tuple[str, ...]
    """``HOST:PORT`` each; the first is asked first."""
    prefix: str = DEFAULT_PREFIX
    """How the keys begin, without a slash at the end."""
    tls: bool = False
    """Whether to use TLS, with the certificate of this machine."""

    @property
    def hosts(self) -> tuple[str, ...]:
        """The endpoints without their ports."""
        return tuple(endpoint.rpartition(":")[0].strip("[]") for endpoint in self.endpoints)

    def __str__(self) -> str:
        return f"{'etcds' if self.tls else 'etcd'}://{','.join(self.endpoints)}{self.prefix}"


StoreAddress: TypeAlias = SqliteAddress | EtcdAddress


def read_store_address(text: str) -> StoreAddress:
    """Read the address of a store.

    Args:
        text: ``sqlite:FOLDER``, ``etcd://HOST[:PORT],...[/PREFIX]``, or ``etcds://...`` with TLS; empty: the
            default folder.

    Raises:
        ValueError: It is none of them; the text says what is expected.

    Example:
        >>> read_store_address("etcd://10.0.0.1,10.0.0.2:12379").endpoints
        ('10.0.0.1:2379', '10.0.0.2:12379')
    """
    if text.startswith(SQLITE):
        folder = text.removeprefix(SQLITE)
        return SqliteAddress(Path(folder).expanduser() if folder else None)
    if not text:
        return SqliteAddress()
    found = _ETCD.fullmatch(text)
    if found is None:
        raise ValueError(f"must be sqlite:FOLDER or etcd://HOST:PORT,HOST:PORT,..., found {text!r:.80}")
    scheme, hosts, prefix = found.groups()
    prefix = (prefix or "").rstrip("/") or DEFAULT_PREFIX
    if not _PREFIX.fullmatch(prefix):
        raise ValueError(f"must have a prefix of letters, digits and . _ - /, found {prefix!r:.60}")
    endpoints = tuple(_read_endpoint(each.strip()) for each in hosts.split(","))
    return EtcdAddress(endpoints, prefix, tls=scheme == "etcds")


def _read_endpoint(text: str) -> str:
    found = _HOST.fullmatch(text)
    if found is None or int(found[2] or 1) not in range(1, _MAX_PORT + 1):
        raise ValueError(f"must name members of etcd as HOST:PORT, found {text!r:.60}")
    return f"{found[1]}:{found[2] or ETCD_PORT}"
