"""Contexts that follow their files, what a program was told, and warnings."""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path

import pytest
from support.other_user import OTHER_USER, as_user

from rce.tls.authority import read_details
from rce.tls.choice import WARNED_VARIABLE, TlsChoice, plain_warning
from rce.tls.expiry import expiry_warning, name_warning
from rce.tls.faults import CertificateError
from rce.tls.folder import CertificateFolder
from rce.tls.identity import TlsFiles, TlsIdentity


@pytest.fixture
def folder(tmp_path: Path) -> CertificateFolder:
    found = CertificateFolder(tmp_path)
    found.make_authority()
    found.issue("cloud", ("cloud.example",))
    return found


def identity_of(folder: CertificateFolder, name: str = "cloud") -> TlsIdentity:
    return TlsIdentity(TlsFiles(folder.certificate(name), folder.key(name), folder.authority))


def test_context_is_kept_until_files_change(folder: CertificateFolder) -> None:
    identity = identity_of(folder)
    first = identity.server()
    assert identity.server() is first
    folder.issue("cloud")
    second = identity.server()
    assert second is not first
    assert identity.server() is second


def test_bad_renewal_keeps_the_former_one(
    folder: CertificateFolder, caplog: pytest.LogCaptureFixture
) -> None:
    """It is complained of once, not with each connection."""
    identity = identity_of(folder)
    first = identity.mutual_server()
    folder.key("cloud").write_bytes(folder.key("authority").read_bytes())
    with caplog.at_level(logging.WARNING):
        assert identity.mutual_server() is first
        assert identity.mutual_server() is first
    (record,) = caplog.records
    said = f"cannot use the certificate {folder.certificate('cloud')}: its key belongs to another certificate"
    assert record.getMessage() == f"the former certificate stays in use: {said}"
    folder.issue("cloud")
    assert identity.mutual_server() is not first


def test_missing_file_is_named(folder: CertificateFolder) -> None:
    with pytest.raises(CertificateError, match=r"robot\.pem does not exist"):
        identity_of(folder, "robot").server()
    folder.key("cloud").unlink()
    with pytest.raises(CertificateError, match=r"cloud\.key does not exist"):
        identity_of(folder).server()
    with pytest.raises(CertificateError, match="cannot use the authority"):
        TlsIdentity(TlsFiles(authority=folder.path / "nowhere.pem")).client()


@pytest.mark.needs("root")
def test_folder_of_another_user_is_named(folder: CertificateFolder, caplog: pytest.LogCaptureFixture) -> None:
    """Its owner may be root, who issued the certificate, and the program a service of another user."""
    serial = read_details(folder.certificate("cloud").read_bytes()).serial
    folder.revoke("cloud")
    folder.issue("cloud")
    used = TlsIdentity(
        TlsFiles(folder.certificate("cloud"), folder.key("cloud"), folder.authority, folder.revoked)
    )
    first = used.mutual_server()
    assert used.is_revoked(serial)
    with as_user(OTHER_USER), caplog.at_level(logging.WARNING):
        for make in (identity_of(folder).server, TlsIdentity(TlsFiles(authority=folder.authority)).client):
            with pytest.raises(CertificateError, match=f"may not be read .*chown it .* to {OTHER_USER}"):
                make()
        assert used.mutual_server() is first
        assert used.is_revoked(serial)
    (record, _) = caplog.records
    assert "the former certificate stays in use" in record.getMessage()


def test_list_of_revoked_that_was_not_read_is_read_again(
    folder: CertificateFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """All files of the program may have been open, for example."""
    identity = TlsIdentity(
        TlsFiles(folder.certificate("cloud"), folder.key("cloud"), folder.authority, folder.revoked)
    )
    serial = read_details(folder.certificate("cloud").read_bytes()).serial
    folder.revoke("cloud")
    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(Path, "read_bytes", fail_to_open)
        assert not identity.is_revoked(serial)
        assert not identity.is_revoked(serial)
    assert len(caplog.records) == 1
    assert identity.is_revoked(serial)


def fail_to_open(path: Path) -> bytes:
    raise OSError(errno.EMFILE, "Too many open files", str(path))


def test_encrypted_key_does_not_ask_at_the_terminal(folder: CertificateFolder) -> None:
    key = folder.key("cloud")
    assert os.system(f"openssl ec -in {key} -aes256 -passout pass:x -out {key} 2>/dev/null") == 0
    with pytest.raises(CertificateError, match="cannot use the certificate"):
        identity_of(folder).server()


def test_choice_of_nothing_is_plain(tmp_path: Path) -> None:
    choice = TlsChoice(folder=tmp_path)
    assert choice.for_clients() is None
    assert choice.for_task_sets() is None


def test_own_certificate_is_for_clients_only(folder: CertificateFolder) -> None:
    choice = TlsChoice(certificate=folder.certificate("cloud"), key=folder.key("cloud"))
    shown = choice.for_clients()
    assert shown is not None
    assert shown.files.authority is None
    assert choice.for_task_sets() is None


def test_key_without_certificate_is_refused(folder: CertificateFolder) -> None:
    with pytest.raises(CertificateError, match="--tls-cert"):
        TlsChoice(key=folder.key("cloud")).for_clients()


@pytest.mark.parametrize(
    ("hosts", "open_ones"),
    [(("127.0.0.1", "::1", "localhost"), ""), (("0.0.0.0",), "0.0.0.0"), (("", "10.1.1.1"), "all addresses")],
)
def test_plain_server_warns_beyond_loopback(
    hosts: tuple[str, ...], open_ones: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(WARNED_VARIABLE, raising=False)
    text = plain_warning("passwords travel", *hosts)
    assert (text is None) == (not open_ones)
    assert open_ones in (text or "")
    monkeypatch.setenv(WARNED_VARIABLE, "1")
    assert plain_warning("passwords travel", *hosts) is None


def test_expiry_says_what_to_do(folder: CertificateFolder) -> None:
    file = folder.certificate("cloud")
    assert expiry_warning(file) is None
    folder.issue("cloud", days=12.5)
    assert "expires in 12 days: renew it where its authority is (rce certificate issue cloud)" in str(
        expiry_warning(file)
    )
    folder.issue("cloud", days=-1)
    assert "has expired" in str(expiry_warning(file))
    assert "cannot read" in str(expiry_warning(folder.path / "nowhere.pem"))


def test_certificate_for_another_name_warns(folder: CertificateFolder) -> None:
    assert name_warning(identity_of(folder), "cloud.example") is None
    text = name_warning(identity_of(folder), "10.0.0.7")
    assert "clients are sent to 10.0.0.7" in str(text)
    assert "--host 10.0.0.7" in str(text)
