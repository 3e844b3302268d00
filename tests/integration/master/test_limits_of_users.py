"""What a new engine lets one user have, through the program, the API and the command."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.config.settings import EngineSettings
from rce.control.messages import MachineInfo
from rce_master.cli import limits
from rce_master.cli.credentials import FILE_VARIABLE, Credentials, save
from rce_master.program import _settings

if TYPE_CHECKING:
    from pathlib import Path

    import pytest
    from integration.master.conftest import RunSite

MACHINE = MachineInfo(name="m", cores=4, slots=40, memory=8 << 30)


async def test_limits_out_of_the_box(
    run_site: RunSite,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With the settings of a program that was told nothing."""
    settings = _settings(EngineSettings())
    async with (
        run_site(state=settings.state, quotas=settings.quotas) as site,
        site.containers(machine=MACHINE),
    ):
        await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
        anna = await site.login("anna", "one")
        shown = (await site.api("GET", "/users/anna", token=anna))["limits"]
        assert {kind: limit["limit"] for kind, limit in shown.items()} == {
            "containers": 200,
            "slots": 30,
            "cpu": 3,
            "memory": 6 << 30,
            "packages": 200,
            "disk": 4 << 30,
        }
        reply = await site.api("POST", "/containers", {"tag": "a", "size": 31}, token=anna, status=409)
        assert "31 slots in all, and you may have 30, 75% of what the machines have" in reply["error"]
        assert "rce user limit anna --slots" in reply["error"]
        await site.api("POST", "/containers", {"tag": "a", "size": 31}, status=204)

        await site.api("PATCH", "/users/anna/limits", {"slots": 40}, token=anna, status=403)
        await site.api("GET", "/users/testUser", token=anna, status=403)
        for body in ({"slots": "many"}, {"slots": -1}, {"cpu": "x"}, {"bogus": 1}, {"packages": 1.5}):
            await site.api("PATCH", "/users/anna/limits", body, status=422)
        await site.api("PATCH", "/users/nobody/limits", {"slots": 1}, status=404)

        monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "login.json"))
        save(Credentials(url=site.url, user="testUser", token=site.token, expires=1e12))
        await limits._limit("anna", {"slots": "5", "memory": "2G", "disk": "0"}, None)
        await limits._show("anna", None)
        told = [line.split() for line in capsys.readouterr().out.splitlines()]
        assert ["slots", "0", "5", "set", "for", "this", "user"] in told
        assert any(line[:1] == ["disk"] and "none" in line for line in told)
        await limits._show("", None)
        told = [line.split() for line in capsys.readouterr().out.splitlines()]
        assert ["slots", "31", "none", "administrators", "have", "none", "unless", "it", "is", "set"] in told
        assert any(line[:1] == ["packages"] and line[-3:] == ["for", "all", "users"] for line in told)
        reply = await site.api("POST", "/containers", {"tag": "a", "size": 6}, token=anna, status=409)
        assert "you may have 5;" in reply["error"]
        await limits._limit("anna", {"slots": "default"}, None)
        shown = (await site.api("GET", "/users/anna", token=anna))["limits"]
        assert (shown["slots"]["limit"], shown["slots"]["source"]) == (30, "machines")
