"""Engine settings, folders, the secret and shipped files."""

from __future__ import annotations

import os
import resource
import stat
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rce.config.exceptions import ConfigError, RunDirError, SecretError
from rce.config.folders import configs_dir, examples_dir, private_folder, run_dir
from rce.config.loading import load_settings
from rce.config.secret import (
    Secret,
    default_secret_file,
    load_secret,
    new_secret,
    read_secret,
    shared_dev_secret,
)
from rce.config.settings import EngineSettings, Runtime


def write(folder: Path, text: str) -> Path:
    file = folder / "engine.yaml"
    file.write_text(text)
    return file


def test_shipped_file_holds_the_defaults() -> None:
    assert load_settings(configs_dir() / "engine.yaml") == EngineSettings() == load_settings()


@pytest.mark.parametrize("text", ["", "# nothing\n", "master:\nrobot:\n"])
def test_empty_file_means_defaults(tmp_path: Path, text: str) -> None:
    assert load_settings(write(tmp_path, text)) == EngineSettings()


def test_settings_are_read(tmp_path: Path) -> None:
    settings = load_settings(
        write(
            tmp_path,
            "state_dir: ~/rce\nmaster_host: '::1'\nmaster: {control_port: 0, robot_grace: 5}\n"
            "container: {runtime: process, package_path: [/a, /b]}\n",
        )
    )
    assert settings.state_dir == Path("~/rce").expanduser()
    assert settings.master.robot_grace == 5.0
    assert settings.container.runtime is Runtime.PROCESS
    assert settings.container.package_path == (Path("/a"), Path("/b"))
    assert settings.control_url == "ws://[::1]:0"


def test_development_mode_binds_loopback_only(tmp_path: Path) -> None:
    settings = load_settings(write(tmp_path, "dev: true\nmaster: {http_port: 1}\n"))
    assert {settings.master.bind, settings.robot.bind, settings.container.bind} == {"127.0.0.1"}
    assert settings.master.http_port == 1


def test_every_fault_is_listed(tmp_path: Path) -> None:
    file = write(
        tmp_path,
        "master: {http_prt: 1, control_port: 70000, bind: 'a b'}\nrobot: {count: 0}\n"
        "container: {runtime: docker, package_path: [3], grace: .inf}\nstate: /x\n",
    )
    with pytest.raises(ConfigError) as caught:
        load_settings(file)
    assert sorted(fault.place for fault in caught.value.faults) == [
        "container.grace",
        "container.package_path[0]",
        "container.runtime",
        "master.bind",
        "master.control_port",
        "master.http_prt",
        "robot.count",
        "state",
    ]
    assert "did you mean 'http_port'?" in str(caught.value)
    assert "must be one of auto, namespace, podman, process" in str(caught.value)


def test_secret_does_not_show() -> None:
    secret = Secret(" very secret \n")
    assert "very" not in f"{secret!r} {secret} {[secret]}"
    assert secret.reveal() == "very secret"
    assert secret.matches("very secret")
    assert not secret.matches("very secret!")
    assert not secret.matches("\udcff")
    assert secret == Secret("very secret")
    assert secret != Secret("other secret")


@pytest.mark.parametrize("text", ["", "short", "line\nbreak in it", "ümläut-secret"])
def test_unfit_secret_is_refused(text: str) -> None:
    with pytest.raises(SecretError) as caught:
        Secret(text)
    assert not text or text not in str(caught.value)


def test_secret_is_found_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "secret"
    file.write_text("from the file\n")
    file.chmod(0o600)
    environ = {"RCE_SECRET": "from the variable", "RCE_SECRET_FILE": str(file)}
    assert load_secret(file, environ=environ).reveal() == "from the file"
    assert load_secret(environ=environ).reveal() == "from the variable"
    del environ["RCE_SECRET"]
    assert load_secret(environ=environ).reveal() == "from the file"
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    with pytest.raises(SecretError, match="run `rce secret new`"):
        load_secret(environ={})
    made = new_secret(default_secret_file())
    assert load_secret(environ={}) == made


def test_new_secret_is_private_and_never_replaces_another(tmp_path: Path) -> None:
    file = tmp_path / "some" / "secret"
    made = new_secret(file)
    assert read_secret(file) == made
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    with pytest.raises(SecretError, match="is there already"):
        new_secret(file)
    with pytest.raises(SecretError, match="cannot make the folder"):
        new_secret(file / "below")
    assert read_secret(file) == made


def test_new_secret_on_a_full_disk_leaves_no_file(tmp_path: Path) -> None:
    """A limit of the file's size stands for the disk."""
    file = tmp_path / "secret"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        with pytest.raises(SecretError, match="cannot make the secret"):
            new_secret(file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not file.exists()
    assert new_secret(file) == read_secret(file)


def test_secret_file_for_everybody_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    file.write_text("secret secret")
    file.chmod(0o644)
    with pytest.raises(SecretError, match="chmod 600"):
        read_secret(file)
    with pytest.raises(SecretError, match="cannot read"):
        read_secret(tmp_path / "missing")


def test_development_secret_is_made_once_and_private(tmp_path: Path) -> None:
    environ = {"XDG_RUNTIME_DIR": str(tmp_path)}
    first = load_secret(dev=True, environ=environ)
    assert load_secret(dev=True, environ=environ) == first
    (file,) = (tmp_path / "rce").iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_programs_that_start_together_agree(tmp_path: Path) -> None:
    together = threading.Barrier(8)

    def start(_: int) -> str:
        together.wait()
        return shared_dev_secret(tmp_path).reveal()

    with ThreadPoolExecutor(8) as pool:
        secrets = list(pool.map(start, range(8)))
    assert len(set(secrets)) == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_run_dir_is_private(tmp_path: Path) -> None:
    (tmp_path / "rce").mkdir(mode=0o755)
    folder = run_dir({"XDG_RUNTIME_DIR": str(tmp_path)})
    assert folder == tmp_path / "rce"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert run_dir({}) == Path(f"/tmp/rce-{os.getuid()}")


def test_runtime_folder_of_somebody_else_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rce.config.folders.private_folder", lambda path: path)
    other = os.getuid() + 1
    assert run_dir({"XDG_RUNTIME_DIR": str(tmp_path)}) == tmp_path / "rce"
    monkeypatch.setattr(os, "getuid", lambda: other)
    assert run_dir({"XDG_RUNTIME_DIR": str(tmp_path)}) == Path(f"/tmp/rce-{other}")
    assert run_dir({"XDG_RUNTIME_DIR": str(tmp_path / "nothing")}) == Path(f"/tmp/rce-{other}")


def test_run_dir_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: real + 1)
    with pytest.raises(RunDirError, match="is not a folder of user"):
        private_folder(tmp_path / "rce")


@pytest.mark.parametrize("kind", ["file", "link"])
def test_run_dir_that_is_no_folder_is_refused(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "rce"
    if kind == "file":
        target.write_text("")
    else:
        (tmp_path / "elsewhere").mkdir()
        target.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunDirError):
        private_folder(target)


def test_shipped_folders_are_found() -> None:
    assert (configs_dir() / "engine.yaml").is_file()
    assert examples_dir().is_dir()
