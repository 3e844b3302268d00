"""An authority, what it issues, and the folder that holds them."""

from __future__ import annotations

import json
import os
import socket
import ssl
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from rce.tls import keeping
from rce.tls.authority import Issued, is_signed_by, issue, make_authority, read_details
from rce.tls.faults import CertificateError
from rce.tls.folder import AUTHORITY, CertificateFolder


@pytest.fixture
def folder(tmp_path: Path) -> CertificateFolder:
    found = CertificateFolder(tmp_path / "certificates")
    found.make_authority()
    return found


def shake_hands(server: ssl.SSLContext, client: ssl.SSLContext, host: str) -> None:
    """Do a whole handshake in memory; raises what either side does."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(to_client, to_server, server_hostname=host),
        server.wrap_bio(to_server, to_client, server_side=True),
    ]
    done: set[int] = set()
    while len(done) < len(ends):
        for index, end in enumerate(ends):
            try:
                end.do_handshake()
                done.add(index)
            except ssl.SSLWantReadError:
                continue
    ends[0].write(b"x")
    assert ends[1].read(1) == b"x"


def contexts(folder: CertificateFolder, name: str) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    server = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=folder.authority)
    server.verify_mode = ssl.CERT_REQUIRED
    server.load_cert_chain(folder.certificate(name), folder.key(name))
    client = ssl.create_default_context(cafile=folder.authority)
    client.verify_flags |= ssl.VERIFY_X509_STRICT
    client.load_cert_chain(folder.certificate(name), folder.key(name))
    return server, client


@pytest.mark.parametrize("host", ["robots.example.org", "10.0.0.7", "::1", "a.wild.example.org"])
def test_issued_certificate_proves_its_hosts(folder: CertificateFolder, host: str) -> None:
    """Strict rules of RFC 5280 included, as newer Pythons apply them."""
    folder.issue("cloud", ("robots.example.org", "10.0.0.7", "[::1]", "*.wild.example.org"))
    shake_hands(*contexts(folder, "cloud"), host)
    assert folder.details("cloud").covers(host)
    with pytest.raises(ssl.SSLCertVerificationError):
        shake_hands(*contexts(folder, "cloud"), "elsewhere.example.org")
    assert not folder.details("cloud").covers("elsewhere.example.org")


def test_files_are_private_and_complete(folder: CertificateFolder) -> None:
    folder.issue("cloud")
    assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700
    files = {file.name: stat.S_IMODE(file.stat().st_mode) for file in folder.path.iterdir()}
    assert files == dict.fromkeys(
        ("authority.pem", "authority.key", "cloud.pem", "cloud.key", "issued.jsonl"), 0o600
    )


def test_second_authority_is_refused(folder: CertificateFolder) -> None:
    before = folder.authority.read_bytes()
    with pytest.raises(CertificateError, match="there is an authority in"):
        folder.make_authority()
    assert folder.authority.read_bytes() == before


def test_authority_that_was_half_made_is_made_again(tmp_path: Path) -> None:
    """A program was killed between the key and the certificate; nothing had been issued."""
    folder = CertificateFolder(tmp_path)
    folder.key(AUTHORITY).write_bytes(b"half")
    assert "made an authority" in folder.ensure("cloud", ("localhost",))
    shake_hands(*contexts(folder, "cloud"), "localhost")


def test_key_of_an_authority_that_has_issued_is_kept(folder: CertificateFolder) -> None:
    folder.issue("cloud")
    folder.authority.unlink()
    before = folder.key(AUTHORITY).read_bytes()
    with pytest.raises(CertificateError, match="there is an authority in"):
        folder.make_authority()
    assert folder.key(AUTHORITY).read_bytes() == before


def test_no_record_is_lost_when_many_programs_issue(folder: CertificateFolder) -> None:
    names = [f"robot{number}" for number in range(40)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda name: CertificateFolder(folder.path).issue(name), names))
        list(pool.map(lambda name: CertificateFolder(folder.path).revoke(name), names))
    assert sorted(folder.owners().values()) == sorted(names)
    assert {one.serial for one in folder.revocations()} == set(folder.owners())


def test_validity_beyond_the_calendar_is_refused(tmp_path: Path) -> None:
    folder = CertificateFolder(tmp_path)
    for days in (1e7, 1e300):
        with pytest.raises(CertificateError, match="ends after the year 9999; take fewer days"):
            folder.make_authority(days)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["authority", "../x", "", ".hidden", "a/b", "x" * 64])
def test_bad_name_is_refused(folder: CertificateFolder, name: str) -> None:
    with pytest.raises(CertificateError, match="cannot be a certificate's name"):
        folder.issue(name)


@pytest.mark.parametrize("host", ["", "a b", "http://x/", "ü.example"])
def test_bad_host_is_refused(folder: CertificateFolder, host: str) -> None:
    with pytest.raises(CertificateError, match="neither a host name nor an IP address"):
        folder.issue("cloud", (host,))


def test_issue_without_authority_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(CertificateError, match="rce certificate init"):
        CertificateFolder(tmp_path).issue("cloud")


def test_renewal_keeps_hosts_and_replaces_key(folder: CertificateFolder) -> None:
    folder.issue("cloud", ("one.example", "10.0.0.7"), days=1)
    key = folder.key("cloud").read_bytes()
    assert folder.issue("cloud").hosts == ("one.example", "10.0.0.7")
    assert folder.details("cloud").days_left() > 390
    assert folder.key("cloud").read_bytes() != key


def test_certificate_ends_with_its_authority() -> None:
    authority = make_authority(days=2)
    found = read_details(issue(authority, "cloud", ["x"], days=100).certificate)
    assert 1 < found.days_left() <= 2


@pytest.mark.parametrize("days", [-0.01, -100])
def test_expired_authority_issues_nothing(tmp_path: Path, days: float) -> None:
    """Also not for ``rce up``, which renews by itself."""
    folder = CertificateFolder(tmp_path / "certificates")
    folder.make_authority(days)
    with pytest.raises(CertificateError, match=r"the authority has expired on .*: make a new one"):
        folder.issue("cloud")
    with pytest.raises(CertificateError, match="the authority has expired on"):
        folder.ensure("engine", ["a.example"])
    assert not folder.has("cloud")


def test_files_are_on_the_disk_before_they_replace_others(
    folder: CertificateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    replace = Path.replace

    def note(file: Path, to: Path) -> Path:
        done.append(to.name)
        return replace(file, to)

    monkeypatch.setattr(os, "fsync", lambda _: done.append("written"))
    monkeypatch.setattr(Path, "replace", note)
    folder.issue("cloud")
    assert done == ["written", "issued.jsonl", "written", "cloud.key", "written", "cloud.pem"]


def test_ensure_makes_renews_and_adds_hosts(folder: CertificateFolder, tmp_path: Path) -> None:
    fresh = CertificateFolder(tmp_path / "fresh")
    assert "made an authority" in fresh.ensure("engine", ["a.example"])
    assert fresh.ensure("engine", ["a.example"]) == ""
    assert "for b.example" in fresh.ensure("engine", ["a.example", "b.example"])
    assert set(fresh.details("engine").hosts) == {"a.example", "b.example"}
    fresh.issue("engine", days=29)
    assert "before it expires" in fresh.ensure("engine", ["a.example"])
    assert fresh.details("engine").days_left() > 390


def test_renewal_leaves_out_lost_addresses_not_named_ones(tmp_path: Path) -> None:
    """A machine gets new addresses every day; what an operator named stays."""
    folder = CertificateFolder(tmp_path / "certificates")
    for day in range(1, 5):
        assert folder.ensure("engine", ["localhost", f"10.0.0.{day}"])
    assert folder.details("engine").hosts == ("localhost", "10.0.0.4")
    folder.issue("engine", ("robots.example", "[fd00::5]"))
    for day in range(1, 5):
        assert folder.ensure("engine", ["localhost", "fd00::5", f"10.0.0.{day}"])
    kept = {"robots.example", "fd00::5", "localhost", "10.0.0.4"}
    assert set(folder.details("engine").hosts) == kept
    assert set(folder.issue("engine").hosts) == kept, "a renewal by hand keeps them as they are"
    assert folder.ensure("engine", ["localhost", "fd00::5", "10.0.0.5"])
    assert set(folder.details("engine").hosts) == {*kept - {"10.0.0.4"}, "10.0.0.5"}


def test_hosts_of_an_older_record_count_as_named(folder: CertificateFolder) -> None:
    folder.issue("engine", ("robots.example",))
    (record,) = (folder.path / "issued.jsonl").read_text().splitlines()
    assert set(json.loads(record)) == {"name", "serial", "expires"}, "as earlier releases wrote it"
    assert folder.ensure("engine", ["localhost"])
    assert set(folder.details("engine").hosts) == {"robots.example", "localhost"}


def test_own_hosts_lack_temporary_addresses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With privacy addresses, a machine has another one each day."""
    there = ["10.0.0.7", "fd00::5", "fd00::abcd", "fe80::1%eth0"]
    families = [socket.AF_INET, *[socket.AF_INET6] * 3]
    found = [SimpleNamespace(family=kind, address=one) for kind, one in zip(families, there, strict=True)]
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: {"eth0": found})
    kernel = tmp_path / "if_inet6"
    monkeypatch.setattr(keeping, "_IPV6_ADDRESSES", kernel)
    assert {*there[:3]} <= set(keeping.own_hosts()), "without IPv6 the kernel has no such file"
    kernel.write_text(
        "fe800000000000000000000000000001 02 40 20 80     eth0\n"
        "fd000000000000000000000000000005 02 40 00 00     eth0\n"
        "fd00000000000000000000000000abcd 02 40 00 01     eth0\n"
    )
    assert set(keeping.own_hosts()) & set(there) == {"10.0.0.7", "fd00::5"}


def test_ensure_leaves_certificates_of_others_alone(folder: CertificateFolder, tmp_path: Path) -> None:
    other = CertificateFolder(tmp_path / "other")
    other.make_authority()
    other.issue("engine", ("a.example",), days=1)
    for file in (other.certificate("engine"), other.key("engine")):
        (folder.path / file.name).write_bytes(file.read_bytes())
    assert folder.ensure("engine", ["b.example"]) == ""
    assert folder.certificate("engine").read_bytes() == other.certificate("engine").read_bytes()


def test_signature_tells_authorities_apart() -> None:
    one, other = make_authority(), make_authority()
    found = issue(one, "cloud", ["x"])
    assert is_signed_by(found.certificate, one.certificate)
    assert not is_signed_by(found.certificate, other.certificate)


def test_garbage_is_refused_with_its_file(folder: CertificateFolder) -> None:
    folder.certificate("cloud").write_text("no certificate")
    with pytest.raises(CertificateError, match=r"cloud\.pem: no certificate in PEM form"):
        folder.details("cloud")
    with pytest.raises(CertificateError, match="the authority cannot be read"):
        issue(Issued(b"x", b"y"), "cloud", [])
    assert dict(folder.all())[AUTHORITY] == folder.details(AUTHORITY)


def test_revoked_name_loses_all_its_certificates(folder: CertificateFolder) -> None:
    """OpenSSL takes the list as it is, and refuses the renewed certificate as well as the former one."""
    former = folder.issue("machine", ("10.0.0.7",)).serial
    renewed = folder.issue("machine", ("10.0.0.7",)).serial
    other = folder.issue("other", ("10.0.0.8",)).serial
    assert {one.serial for one in folder.revoke("machine")} == {former, renewed}
    assert folder.revoke("machine") == []
    assert {one.serial for one in folder.revocations()} == {former, renewed}
    assert folder.owners() == {former: "machine", renewed: "machine", other: "other"}
    server, client = contexts(folder, "machine")
    client.load_verify_locations(folder.revoked)
    client.verify_flags |= ssl.VERIFY_CRL_CHECK_LEAF
    with pytest.raises(ssl.SSLCertVerificationError, match="revoked"):
        shake_hands(server, client, "10.0.0.7")
    server, client = contexts(folder, "other")
    client.load_verify_locations(folder.revoked)
    client.verify_flags |= ssl.VERIFY_CRL_CHECK_LEAF
    shake_hands(server, client, "10.0.0.8")
    assert folder.issue("machine").serial not in {one.serial for one in folder.revocations()}


def test_revoked_certificate_of_the_engine_is_renewed_at_start(folder: CertificateFolder) -> None:
    serial = folder.issue("engine", ("localhost",)).serial
    assert folder.ensure("engine", ("localhost",)) == ""
    folder.revoke("engine")
    assert "because it was revoked" in folder.ensure("engine", ("localhost",))
    assert folder.details("engine").serial != serial


@pytest.mark.parametrize("name", ["unknown", AUTHORITY, "revoked"])
def test_revoking_what_was_not_issued_is_refused(folder: CertificateFolder, name: str) -> None:
    with pytest.raises(CertificateError, match=f"no certificate '{name}' was issued in"):
        folder.revoke(name)
    assert not folder.revoked.exists()


def test_certificate_of_another_authority_is_revoked_elsewhere(
    folder: CertificateFolder, tmp_path: Path
) -> None:
    other = CertificateFolder(tmp_path / "other")
    other.make_authority()
    other.issue("machine")
    folder.certificate("machine").write_bytes(other.certificate("machine").read_bytes())
    with pytest.raises(CertificateError, match="another authority issued"):
        folder.revoke("machine")


def test_list_of_another_authority_is_named(folder: CertificateFolder, tmp_path: Path) -> None:
    other = CertificateFolder(tmp_path / "other")
    other.make_authority()
    other.issue("machine")
    other.revoke("machine")
    folder.revoked.write_bytes(other.revoked.read_bytes())
    with pytest.raises(CertificateError, match="another authority signed it"):
        folder.revocations()


def test_new_authority_begins_with_nothing_revoked(folder: CertificateFolder) -> None:
    folder.issue("machine")
    folder.revoke("machine")
    for file in (folder.authority, folder.key(AUTHORITY)):
        file.unlink()
    folder.make_authority()
    assert folder.revocations() == []
    assert folder.owners() == {}


@pytest.mark.needs("root")
def test_root_leaves_renewed_files_to_their_owner(folder: CertificateFolder) -> None:
    """Services run as a user of their own; the authority's key and those of other machines stay root's."""
    folder.issue("engine", ("10.0.0.1",))
    services = 12345
    for path in (folder.path, folder.authority, folder.certificate("engine"), folder.key("engine")):
        os.chown(path, services, services)
    folder.issue("engine")
    folder.issue("m2", ("10.0.0.2",))
    folder.revoke("m2")
    owners = {path.name: (path.stat().st_uid, path.stat().st_gid) for path in folder.path.iterdir()}
    of_services = {"authority.pem", "engine.pem", "engine.key", "revoked.pem"}
    assert {name for name, owner in owners.items() if owner == (services, services)} == of_services
    assert {owners[name] for name in ("authority.key", "m2.key", "m2.pem")} == {(0, 0)}
    assert {stat.S_IMODE(folder.path.joinpath(name).stat().st_mode) for name in owners} == {0o600}
    folder.revoke("engine")
    assert folder.revoked.stat().st_uid == services
