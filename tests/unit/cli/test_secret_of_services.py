"""The secret of services: read by their user through its group, written by root only."""

from __future__ import annotations

import os
import pwd
import stat
from pathlib import Path

import pytest
import typer

from rce.cli import service as services
from rce.cli.service import _open_secret, check
from rce.services.units import Role, Service

pytestmark = pytest.mark.needs("root")

USER = "daemon"


@pytest.fixture
def secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A secret in a folder of settings that only root may enter, as `rce secret new` makes them."""
    folder = tmp_path / "rce"
    folder.mkdir(mode=0o700)
    (folder / "secret").write_text("a secret of services\n")
    (folder / "secret").chmod(0o600)
    monkeypatch.setattr(services, "SYSTEM_CONFIG", folder)
    return folder / "secret"


def service(secret: Path, user: str = USER) -> Service:
    return Service(role=Role.MASTER, program=Path("/bin/true"), user=user, secret=secret)


def access(path: Path) -> tuple[int, int, int]:
    found = path.stat()
    return found.st_uid, found.st_gid, stat.S_IMODE(found.st_mode)


def test_user_of_a_service_may_read_its_secret(secret: Path) -> None:
    group = pwd.getpwnam(USER).pw_gid
    for _ in range(2):
        _open_secret(service(secret))
        assert access(secret) == (0, group, 0o640)
        assert access(secret.parent) == (0, group, 0o710)


def test_secret_that_its_user_reads_stays_as_it_is(secret: Path) -> None:
    account = pwd.getpwnam(USER)
    secret.parent.chmod(0o755)
    os.chown(secret, account.pw_uid, 0)
    _open_secret(service(secret))
    assert access(secret) == (account.pw_uid, 0, 0o600)
    assert access(secret.parent) == (0, 0, 0o755)


def test_group_of_several_users_gets_no_secret(
    secret: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    group = pwd.getpwnam(USER).pw_gid
    other = pwd.struct_passwd(("anna", "x", 4711, group, "", "/", "/bin/sh"))
    monkeypatch.setattr(pwd, "getpwall", lambda: [pwd.getpwnam(USER), other])
    with pytest.raises(typer.Exit):
        _open_secret(service(secret))
    assert "anna is in it too" in capsys.readouterr().err
    assert access(secret) == (0, 0, 0o600)


def test_group_that_reads_a_secret_is_not_shut_out(secret: Path) -> None:
    os.chown(secret, 0, 4711)
    secret.chmod(0o640)
    with pytest.raises(typer.Exit):
        _open_secret(service(secret))
    assert access(secret) == (0, 4711, 0o640)


def test_secret_in_a_closed_folder_is_refused(
    secret: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(services, "TEMPORARY", ())
    monkeypatch.setattr(services, "_needed", lambda _: ())
    monkeypatch.setattr(services, "SYSTEM_CONFIG", Path("/etc/rce"))
    with pytest.raises(typer.Exit):
        check(service(secret))
    assert f"user {USER} may not enter {secret.parent}" in capsys.readouterr().err
    check(service(secret, user=""))
