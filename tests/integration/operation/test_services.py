"""``rce install-service``: units that systemd takes, and whose programs start."""

from __future__ import annotations

import asyncio
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import typer
from support.engine import Program

from rce.cli.service import check
from rce.services.units import Role, Service, quoted, unit

RCE = str(Path(sys.executable).parent / "rce")


def rce(tmp_path: Path, *arguments: str, code: int = 0) -> str:
    env = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path / "config"), "COLUMNS": "300"}
    env["PATH"] = ""  # systemctl is not found: a test installs nothing on the machine
    done = subprocess.run([RCE, *arguments], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def command_line(text: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith("ExecStart=")]
    return shlex.split(line.removeprefix("ExecStart="))


@pytest.mark.needs("systemd")
@pytest.mark.parametrize("scope", ["--system", "--user"])
@pytest.mark.parametrize("role", list(Role))
def test_systemd_accepts_every_unit(role: Role, scope: str, tmp_path: Path) -> None:
    settings = tmp_path / "settings with 100% $HOME.yaml"
    settings.write_text(f"state_dir: {tmp_path}/state\n")
    arguments = ["--", "10.0.0.1"] if role in (Role.ROBOT, Role.CONTAINER) else []
    text = rce(
        tmp_path,
        *("install-service", role, scope, "--print", "--run-as", "daemon", "--config", str(settings)),
        *arguments,
    )
    file = tmp_path / f"rce-{role}.service"
    file.write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", str(file)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    assert ("Delegate=yes" in text) == (role in (Role.CONTAINER, Role.ENGINE))
    assert ("ExecReload=/bin/kill -USR1 $MAINPID" in text) == (role is Role.CONTAINER)
    assert ("After=rce-etcd.service" in text) == (role is Role.MASTER)


@pytest.mark.needs("systemd")
@pytest.mark.parametrize("role", [Role.MASTER, Role.ROBOT])
def test_master_and_robot_units_have_few_rights(role: Role, tmp_path: Path) -> None:
    """systemd's own score, 0 to 10: more is more exposed; 9.6 is a unit without any of it."""
    file = tmp_path / f"rce-{role}.service"
    file.write_text(unit(Service(role=role, program=Path("/bin/true"), user="daemon", secret=Path("/s"))))
    subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--threshold=25", str(file)],
        check=True,
        capture_output=True,
    )


async def test_command_of_a_unit_starts_its_program(tmp_path: Path) -> None:
    settings = tmp_path / "settings with 100% $HOME.yaml"
    secret = tmp_path / "secret of 100%"
    settings.write_text(
        f"state_dir: '{tmp_path}/its state'\nmaster: {{http_port: 0, control_port: 0}}\n"
        f"secret_file: '{secret}'\n"
    )
    rce(tmp_path, "secret", "new", str(secret))
    text = rce(tmp_path, "install-service", "master", "--system", "--print", "--config", str(settings))
    argv = command_line(text)
    argv = [word.replace("%%", "%").replace("$$", "$") for word in argv]  # as systemd does
    assert argv[-2:] == ["--secret-file", str(secret)]
    program = Program("master", argv, dict(os.environ), tmp_path)
    await program.start(ready="rce-master ready: ", timeout=50)
    assert await program.stop() == 0
    assert (tmp_path / "its state" / "master").is_dir()


@pytest.mark.parametrize("role", [Role.ENGINE, Role.MASTER, Role.ROBOT, Role.CONTAINER])
def test_unit_reads_the_secret_where_it_is_changed(role: Role) -> None:
    """systemd copies a credential once, so a program would never see that the secret was changed."""
    secret = Path("/etc/rce/secret")
    text = unit(Service(role=role, program=Path("/bin/true"), secret=secret))
    assert command_line(text) == ["/bin/true", "--secret-file", str(secret)]
    assert "LoadCredential" not in text


@pytest.mark.needs("root")
def test_unit_that_could_not_start_is_refused(tmp_path: Path) -> None:
    settings = tmp_path / "engine.yaml"
    settings.write_text(f"secret_file: {tmp_path}/none\n")
    told = rce(tmp_path, "install-service", "engine", "--system", "--config", str(settings), code=1)
    assert f"rce secret new {tmp_path}/none" in told
    settings.write_text("mastr: {}\n")
    told = rce(tmp_path, "install-service", "engine", "--config", str(settings), code=2)
    assert "did you mean 'master'" in told


@pytest.mark.parametrize("folder", ["/tmp", "/var/tmp"])
def test_program_that_its_service_would_not_see_is_refused(
    folder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The units of master and robot have ``PrivateTmp``: systemd would only say 203/EXEC."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        program = Path(place, "rce-master")
        program.touch()
        with pytest.raises(typer.Exit):
            check(Service(role=Role.MASTER, program=program))
        assert f"{program} cannot run as a service" in capsys.readouterr().err
        check(Service(role=Role.CONTAINER, program=program))


async def test_user_unit_is_installed_and_removed(tmp_path: Path) -> None:
    """Where systemd does not run, it says what to do on the machine."""
    file = tmp_path / "config/systemd/user/rce-engine.service"
    told = await asyncio.to_thread(rce, tmp_path, "install-service", "engine", "--user")
    assert "systemctl --user enable --now rce-engine.service" in told
    assert f"ExecStart={Path(sys.executable).parent}/rce up" in file.read_text()
    told = await asyncio.to_thread(rce, tmp_path, "uninstall-service", "engine", "--user")
    assert "systemctl --user disable --now rce-engine.service" in told
    assert not file.exists()
    assert "does not exist" in await asyncio.to_thread(
        rce, tmp_path, "uninstall-service", "engine", "--user", code=1
    )


@pytest.mark.parametrize(
    ("word", "written"),
    [
        ("plain-word", "plain-word"),
        ("two words", '"two words"'),
        ("100%", '"100%%"'),
        ("$HOME", '"$$HOME"'),
        ('"', '"\\""'),
        ("", '""'),
    ],
)
def test_words_are_quoted_for_systemd(word: str, written: str) -> None:
    assert quoted(word) == written


def test_word_with_a_line_break_is_refused() -> None:
    with pytest.raises(ValueError, match="control character"):
        quoted("a\nExecStartPre=b")
