"""The certificates of services: given to their user at the installation, but the authority's key."""

from __future__ import annotations

import pwd
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from support.other_user import as_user

from rce.cli import service as services
from rce.cli.service import _open_certificates, check, make_service
from rce.services.units import Role, Service
from rce.tls.choice import TlsChoice
from rce.tls.folder import CertificateFolder

pytestmark = pytest.mark.needs("root")

USER = "daemon"


@pytest.fixture
def folder() -> Iterator[CertificateFolder]:
    """What root makes by ``rce certificate init`` and ``issue``; the folder above is open."""
    with tempfile.TemporaryDirectory(prefix="rce-") as above:
        Path(above).chmod(0o755)
        made = CertificateFolder(Path(above, "certificates"))
        made.make_authority()
        made.issue("cloud")
        made.issue("m2")
        yield made


def service(folder: CertificateFolder, name: str = "cloud") -> Service:
    files = folder.authority, folder.certificate(name), folder.key(name)
    return Service(role=Role.ROBOT, program=Path("/bin/true"), user=USER, certificates=files)


def test_user_of_a_service_may_use_its_certificate(folder: CertificateFolder) -> None:
    folder.revoke("m2")
    for _ in range(2):
        _open_certificates(service(folder))
    given = {path.name for path in folder.path.iterdir() if path.stat().st_uid != 0}
    assert given == {"authority.pem", "cloud.pem", "cloud.key", "revoked.pem"}
    with as_user(pwd.getpwnam(USER).pw_uid):
        assert TlsChoice(enabled=True, folder=folder.path, name="cloud").for_task_sets() is not None


def test_link_of_its_user_gives_no_other_file(
    folder: CertificateFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = tmp_path / "secret"
    secret.touch(mode=0o600)
    folder.key("cloud").unlink()
    folder.key("cloud").hardlink_to(secret)
    with pytest.raises(typer.Exit):
        _open_certificates(service(folder))
    assert secret.stat().st_uid == 0
    assert f"user {USER} may not read {folder.key('cloud')}" in capsys.readouterr().err


def test_missing_certificate_of_a_service_is_named(
    folder: CertificateFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(services, "TEMPORARY", ())
    monkeypatch.setattr(services, "_needed", lambda _: ())
    with pytest.raises(typer.Exit):
        check(service(folder, "m3"))
    assert f"rce certificate issue m3 --certificates {folder.path}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "arguments", "files"),
    [
        ("", ("10.0.0.1",), []),
        ("tls: {enabled: true}", ("10.0.0.1",), ["state/certificates/engine"]),
        ("", ("10.0.0.1", "--tls", "--certificate", "m2"), ["state/certificates/m2"]),
        ("", ("--tls", "--certificates=/etc/rce/tls"), ["/etc/rce/tls/engine"]),
    ],
)
def test_certificates_of_a_unit_are_found(
    tmp_path: Path, text: str, arguments: tuple[str, ...], files: list[str]
) -> None:
    settings = tmp_path / "engine.yaml"
    settings.write_text(f"state_dir: {tmp_path}/state\n{text}\n")
    made = make_service(Role.ROBOT, arguments, system=True, config=settings, run_as=USER)
    stems = {str(path.with_suffix("")) for path in made.certificates if path.stem != "authority"}
    assert stems == {str(tmp_path / file) for file in files}
