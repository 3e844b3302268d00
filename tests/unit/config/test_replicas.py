"""``rce up --replicas``: the programs of several masters and their etcd on one machine."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from rce.cli.replicas import Replicas, ReplicasError
from rce.cli.up import plan
from rce.config.settings import EngineSettings, MasterSettings, TlsSettings

if TYPE_CHECKING:
    from pathlib import Path

    from rce.supervision.plan import Program

THREE = MasterSettings(replicas=3)


@pytest.fixture(autouse=True)
def etcd(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Nothing is started here, so etcd need not be installed: a script tells its version."""
    program = tmp_path_factory.mktemp("bin") / "etcd"
    program.write_text("#!/bin/sh\necho 'etcd Version: 3.4.0'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))
    return program


def settings_of(program: Program) -> dict[str, Any]:
    found = json.loads(program.argv[program.argv.index("--settings") + 1])
    assert isinstance(found, dict)
    return found


def options_of(program: Program) -> dict[str, str]:
    words = [word for word in program.argv if not word.endswith(("client-cert-auth", "pre-vote"))]
    begin = words.index("--name")
    return dict(zip(words[begin::2], words[begin + 1 :: 2], strict=True))


def test_members_of_etcd_come_first_and_each_master_asks_its_own(tmp_path: Path) -> None:
    made = plan(EngineSettings(state_dir=tmp_path, log_dir=tmp_path / "log", master=THREE))
    programs = {program.name: program for program in made.programs}
    members, masters = ["etcd-m1", "etcd-m2", "etcd-m3"], ["master1", "master2", "master3"]
    assert list(programs) == [*members, *masters, "robot", "container"]
    ports = json.loads((tmp_path / "etcd" / "ports.json").read_text())
    assert len(set(ports)) == 6
    own = [settings_of(programs[name])["master"] for name in masters]
    assert [one["http_port"] for one in own] == [9000, 9001, 9002]
    assert [one["control_port"] for one in own] == [8080, 8081, 8082]
    first = ",".join(f"127.0.0.1:{port}" for port in ports[::2])
    assert own[0]["store"] == f"etcd://{first}"
    assert str(own[1]["store"]).startswith(f"etcd://127.0.0.1:{ports[2]},")
    assert [one.get("state_dir") for one in own] == [None, f"{tmp_path}/master2", f"{tmp_path}/master3"]
    logs = {settings_of(programs[name])["log_dir"] for name in masters}
    assert len(logs) == 3, "two programs cannot rotate one file"
    for name in ("robot", "container"):
        assert settings_of(programs[name])["master_host"] == "127.0.0.1:8080,127.0.0.1:8081,127.0.0.1:8082"
    assert made.ready == ("RCE ready: http://127.0.0.1:9000/,http://127.0.0.1:9001/,http://127.0.0.1:9002/",)
    assert [programs[name].ready for name in masters] == [" ready: ", " stand-by: ", " stand-by: "]
    assert options_of(programs["etcd-m2"])["--data-dir"] == f"{tmp_path}/etcd/m2"
    assert "every user of this machine" in made.warnings[-1]


def test_old_etcd_is_refused(etcd: Path, tmp_path: Path) -> None:
    """It would end by an option that it does not know, and be started again and again."""
    etcd.write_text("#!/bin/sh\necho 'etcd Version: 3.3.25'\n")
    with pytest.raises(ReplicasError, match=r"is version 3\.3; version 3\.4 or later is needed"):
        plan(EngineSettings(state_dir=tmp_path, master=THREE))


def test_ports_stay_and_the_number_of_members_too(tmp_path: Path) -> None:
    settings = EngineSettings(state_dir=tmp_path, master=THREE)
    first = [options_of(program) for program in plan(settings).programs[:3]]
    assert [options_of(program) for program in plan(settings).programs[:3]] == first
    with pytest.raises(ReplicasError, match="data of 3 members of etcd: give --replicas 3, or another"):
        plan(replace(settings, master=MasterSettings(replicas=5)))


def test_with_tls_etcd_asks_for_certificates(tmp_path: Path) -> None:
    made = plan(EngineSettings(state_dir=tmp_path, master=THREE, tls=TlsSettings(enabled=True)))
    member, master = made.programs[0], made.programs[3]
    options = options_of(member)
    assert options["--listen-client-urls"].startswith("https://127.0.0.1:")
    assert options["--peer-cert-file"] == options["--cert-file"] == f"{tmp_path}/certificates/engine.pem"
    assert {"--client-cert-auth", "--peer-client-cert-auth"} <= set(member.argv)
    assert str(settings_of(master)["master"]["store"]).startswith("etcds://")
    assert not made.warnings


@pytest.mark.parametrize("count", [0, 2, 4, 7])
def test_only_numbers_that_survive_a_failure_are_taken(tmp_path: Path, count: int) -> None:
    with pytest.raises(ReplicasError, match=f"must be 3 or 5, found {count}"):
        Replicas(EngineSettings(state_dir=tmp_path, master=MasterSettings(replicas=count)))
    assert not (tmp_path / "etcd").exists()


@pytest.mark.parametrize(
    ("master", "why"),
    [
        (MasterSettings(replicas=3, http_port=0), "known ports"),
        (MasterSettings(replicas=3, control_port=0), "known ports"),
        (MasterSettings(replicas=3, store="sqlite:/x"), "an etcd of its own"),
    ],
)
def test_settings_that_do_not_fit_are_refused(tmp_path: Path, master: MasterSettings, why: str) -> None:
    with pytest.raises(ReplicasError, match=why):
        plan(EngineSettings(state_dir=tmp_path, master=master))


def test_missing_etcd_is_named(etcd: Path, tmp_path: Path) -> None:
    etcd.unlink()
    with pytest.raises(ReplicasError, match="etcd is not installed"):
        Replicas(EngineSettings(state_dir=tmp_path, master=THREE))


def test_bad_ports_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "etcd").mkdir()
    (tmp_path / "etcd" / "ports.json").write_text("[1, 2")
    with pytest.raises(ReplicasError, match=r"ports\.json cannot be used"):
        Replicas(EngineSettings(state_dir=tmp_path, master=THREE))
