"""A server may be asked for by the names in its certificate, as they are now."""

from __future__ import annotations

from pathlib import Path

from rce.tls.folder import CertificateFolder
from rce.tls.identity import TlsFiles, TlsIdentity
from rce.tls.names import CertificateNames
from rce.web.origin import ServerNames


def test_names_of_a_certificate_are_known(tmp_path: Path) -> None:
    folder = CertificateFolder(tmp_path)
    folder.make_authority()
    folder.issue("cloud", ("Cloud.example.org", "10.0.0.1"))
    identity = TlsIdentity(TlsFiles(folder.certificate("cloud"), folder.key("cloud")))
    names = ServerNames("0.0.0.0", (), CertificateNames(identity))
    assert "cloud.example.org:9000" in names
    assert "fleet.example.org" not in names
    folder.issue("cloud", ("fleet.example.org", "*.wild.example.org"))
    assert "fleet.example.org" in names
    assert "cloud.example.org" not in names
    assert "a.wild.example.org" not in names
    assert "*.wild.example.org" not in names
    folder.certificate("cloud").unlink()
    assert "fleet.example.org" in names
    assert "fleet.example.org" not in ServerNames("0.0.0.0", (), CertificateNames(None))
