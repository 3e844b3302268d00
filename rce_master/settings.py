"""The settings of a master."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce.config import ANYWHERE, EngineSettings, EtcdAddress, default_state_dir
from rce.tls.choice import TlsChoice
from rce_master.quotas import QuotaSettings
from rce_master.state.settings import StateSettings
from rce_master.tokens import TOKEN_LIFETIME_S

if TYPE_CHECKING:
    from pathlib import Path


HTTP_PORT = 9000
CONTROL_PORT = 8080


@dataclass(frozen=True, slots=True, kw_only=True)
class MasterSettings:
    """The settings of a master. Port 0 takes a free one."""

    bind: str = ANYWHERE
    http_port: int = HTTP_PORT
    control_port: int = CONTROL_PORT
    state_dir: Path = field(default_factory=lambda: default_state_dir() / "master")
    etcd: EtcdAddress | None = None
    """Where the state is; None: in an SQLite file in the state folder."""
    lease: float = 3.0
    """Seconds that the lead lasts without a renewal."""
    advertise: str = ""
    """Host by which other masters reach this one; empty: the address on the way to etcd, or ``bind``."""
    name: str = ""
    """This master's name among several, such as ``machine1:9000``."""
    dev: bool = False
    """Make the user testUser with the password testUser, an administrator."""
    tls: TlsChoice = field(default_factory=TlsChoice)
    allowed_origins: tuple[str, ...] = ()
    public_names: tuple[str, ...] = ()
    """Allowed host names of the server, beside its address, its host name and ``localhost``."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses or networks of proxies whose ``X-Forwarded-For`` is trusted."""
    token_lifetime: float = TOKEN_LIFETIME_S
    """Seconds."""
    quotas: QuotaSettings = field(default_factory=QuotaSettings)
    """The quotas of one user."""
    state: StateSettings = field(default_factory=StateSettings)

    @property
    def names(self) -> tuple[str, ...]:
        """All host names of the server that are allowed beside its own."""
        return (*self.public_names, *((self.advertise,) if self.advertise else ()))


def state_settings(engine: EngineSettings) -> StateSettings:
    """Make the settings of the state of the engine's."""
    own = engine.master
    return StateSettings(
        robot_grace=own.robot_grace,
        container_grace=own.container_grace,
        user_share=own.user_share,
        max_containers=own.max_containers,
        max_packages=own.max_packages,
        max_package_size=own.max_disk,
        max_slots=own.max_slots,
        max_cpu=own.max_cpu,
        max_memory=own.max_memory,
    )
