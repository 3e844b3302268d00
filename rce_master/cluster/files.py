"""The configuration of a member of etcd, and the folders of its machine."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import yaml

from rce.config import ETCD_FILE, MASTER_FOLDER
from rce.tls.choice import ENGINE
from rce.tls.folder import CertificateFolder
from rce_master.cluster.members import ClusterError
from rce_master.store.etcd.layout import MAX_OPERATIONS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rce_master.cluster.members import Member

CERTIFICATE = ENGINE
"""Name of the certificate that each machine of a cluster shows; each has its own."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,62}")
_KEYS = {"name", "advertise-client-urls", "initial-advertise-peer-urls", "initial-cluster"}
"""What a configuration must have."""
_STATE = "initial-cluster-state"
_JOINS = "existing"
_REVOCATION = ("ClientTLSInfo", "PeerTLSInfo")
"""Where etcd takes the list of revoked certificates, which it reads at each connection: its configuration has
no key of its own for the list, only the names of its fields."""
_FIXED = {
    "enable-grpc-gateway": True,  # etcd 3.4 leaves it out if a file configures it
    "pre-vote": True,  # else a member that was cut off makes the others elect anew when it is back
    "max-txn-ops": MAX_OPERATIONS,
    "max-request-bytes": 16 * 2**20,
    "quota-backend-bytes": 8 * 2**30,
    "auto-compaction-mode": "periodic",
    "auto-compaction-retention": "5m",
    "logger": "zap",
    "log-level": "warn",
}


@dataclass(frozen=True, slots=True)
class Machine:
    """One machine of the cluster: a member of etcd and a master.

    Attributes:
        name: Its name in the cluster.
        host: Its address, for other machines too.
        client_port: Port of its etcd for masters.
        peer_port: Port of its etcd for other members.
        folder: Its state folder.
        tls: Whether etcd and the master use TLS.
    """

    name: str
    host: str
    client_port: int
    peer_port: int
    folder: Path
    tls: bool

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ClusterError(
                f"{self.name!r} cannot be a machine's name: use up to 63 letters, digits, '.', '_' and '-'"
            )

    @property
    def client(self) -> str:
        """``HOST:PORT`` of its etcd for masters."""
        return f"{self._host}:{self.client_port}"

    @property
    def peer(self) -> str:
        """``HOST:PORT`` of its etcd for other members."""
        return f"{self._host}:{self.peer_port}"

    @property
    def peer_url(self) -> str:
        """The URL of its etcd for other members."""
        return f"{self.scheme}://{self.peer}"

    @property
    def scheme(self) -> str:
        """Of URLs of etcd."""
        return "https" if self.tls else "http"

    @property
    def config(self) -> Path:
        """The file with etcd's configuration."""
        return self.folder / ETCD_FILE

    @property
    def data(self) -> Path:
        """The folder with etcd's data."""
        return self.folder / "etcd"

    @property
    def certificates(self) -> Path:
        """The folder of certificates."""
        return self.folder / "certificates"

    @property
    def master(self) -> Path:
        """The folder of its master."""
        return self.folder / MASTER_FOLDER

    @property
    def _host(self) -> str:
        return f"[{self.host}]" if ":" in self.host else self.host

    def document(self, peers: dict[str, str], *, new: bool) -> dict[str, Any]:
        """Return etcd's configuration.

        Args:
            peers: URL for other members of each member by its name, this one included.
            new: Whether it begins a cluster; else it joins one.
        """
        client_url = f"{self.scheme}://{self.client}"
        found: dict[str, Any] = {
            "name": self.name,
            "data-dir": str(self.data),
            "listen-client-urls": client_url,
            "advertise-client-urls": client_url,
            "listen-peer-urls": self.peer_url,
            "initial-advertise-peer-urls": self.peer_url,
            "initial-cluster": ",".join(f"{name}={url}" for name, url in peers.items()),
            _STATE: "new" if new else _JOINS,
            **_FIXED,
        }
        if self.tls:
            security = {
                "cert-file": str(self.certificates / f"{CERTIFICATE}.pem"),
                "key-file": str(self.certificates / f"{CERTIFICATE}.key"),
                "trusted-ca-file": str(self.certificates / "authority.pem"),
                "client-cert-auth": True,
            }
            found |= {"client-transport-security": security, "peer-transport-security": security}
            revoked = CertificateFolder(self.certificates).revoked
            if revoked.exists():  # with a file that is missing, etcd refuses all
                found |= {key: {"CRLFile": str(revoked)} for key in _REVOCATION}
        return found

    def write(self, peers: dict[str, str], *, new: bool) -> None:
        """Write etcd's configuration.

        Raises:
            ClusterError: It cannot be written.
        """
        text = yaml.dump(self.document(peers, new=new), Dumper=_PlainDumper, sort_keys=False)
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o755)
            self.config.write_text(f"# Made by `rce cluster`.\n{text}", encoding="utf-8")
            self.config.chmod(0o644)  # etcd's user reads it, whatever the umask is; it has no secrets
        except OSError as error:
            raise ClusterError(f"cannot write {self.config}: {error}") from error

    def keep(self, members: Sequence[Member]) -> None:
        """Write etcd's configuration once this machine is a member: with all members, and as one that joins.

        If the data is lost, etcd then ends. As one that begins a cluster it would begin another one, on whose
        empty state a master would lead.

        Raises:
            ClusterError: It cannot be written.
        """
        named = {each.name: f"{self.scheme}://{each.peer}" for each in members if each.name}
        self.write(named, new=False)

    def check_data(self) -> None:
        """Check that the first machine of a cluster still has its data, once it was a member.

        Raises:
            ClusterError: It has not; etcd itself leaves an empty folder then.
        """
        if any(self.data.glob("member/wal/*.wal")):
            return
        if self.config.exists() and read_config(self.config).get(_STATE) == _JOINS:
            raise ClusterError(
                f"this machine is in a cluster by {self.config}, and its data is lost. To join again:"
                f" `rce cluster remove {self.name}` on another machine, remove {self.config} here, then"
                " `rce cluster join`. To begin another cluster, remove that file"
            )

    def store(self, endpoints: tuple[str, ...]) -> str:
        """Return the address of the store for the machine's master: its own member of etcd first.

        Args:
            endpoints: ``HOST:PORT`` of all members of etcd.
        """
        own = self.client
        hosts = ",".join([own, *(each for each in endpoints if each != own)])
        return f"{'etcds' if self.tls else 'etcd'}://{hosts}"

    def master_arguments(self, endpoints: tuple[str, ...]) -> list[str]:
        """Return the arguments of the machine's master.

        Args:
            endpoints: ``HOST:PORT`` of all members of etcd.
        """
        found = ["--store", self.store(endpoints), "--advertise", self.host]
        found += ["--machine", self.name]
        if self.tls:
            found += ["--tls", "--certificates", str(self.certificates)]
        return found


class _PlainDumper(yaml.SafeDumper):
    """Writes one mapping twice in place of a reference to it, for people who read the file."""

    def ignore_aliases(self, data: Any) -> bool:
        del data
        return True


def read_config(path: Path) -> dict[str, Any]:
    """Read a configuration that ``rce cluster`` wrote.

    Raises:
        ClusterError: There is none, or it cannot be read.
    """
    if not path.exists():
        raise ClusterError(
            f"this machine is in no cluster: {path} is missing; give the address of a member with --etcd, or"
            " another --state-dir"
        )
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ClusterError(f"{path} cannot be read: {error}") from error
    if not isinstance(document, dict) or not document.keys() >= _KEYS:
        raise ClusterError(
            f"{path} is not a configuration of rce cluster: it lacks {', '.join(sorted(_KEYS))}"
        )
    return dict(document)
