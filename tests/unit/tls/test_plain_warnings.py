"""Each program of an engine warns if other machines reach a port of it without TLS."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest

from rce.config import EtcdAddress, Secret
from rce.tls.choice import WARNED_VARIABLE, TlsChoice
from rce.tls.folder import CertificateFolder
from rce_container.app import App as ContainerApp
from rce_container.exceptions import RuntimeUnavailableError
from rce_container.settings import ContainerSettings
from rce_master.master import Master
from rce_master.program import _run as run_master
from rce_master.replicated import ReplicatedMaster
from rce_master.settings import MasterSettings
from rce_robot.app import App as RobotApp
from rce_robot.settings import RobotSettings

if TYPE_CHECKING:
    from pathlib import Path

SECRET = Secret("secret of the tests")
TASK_SETS = "messages between task sets, and their secret, travel in clear: this listens on "


@pytest.fixture(autouse=True)
def unwarned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(WARNED_VARIABLE, raising=False)


@pytest.fixture
def clients_only(tmp_path: Path) -> TlsChoice:
    """A certificate for clients, and no TLS between task sets."""
    folder = CertificateFolder(tmp_path)
    folder.make_authority()
    folder.issue("public", ("127.0.0.1",))
    return TlsChoice(certificate=folder.certificate("public"), key=folder.key("public"))


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    texts = [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]
    return [text for text in texts if "without TLS" in text]


@pytest.mark.parametrize(("host", "place"), [("", "all addresses"), ("10.0.0.1", "10.0.0.1"), ("::1", None)])
async def test_container_task_set_warns_of_its_links(
    host: str, place: str | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = ContainerSettings(machine="here")
    app = ContainerApp(
        master="127.0.0.1",
        control_port=1,
        secret=SECRET,
        settings=settings,
        runtime="none",  # so that it ends here
        host=host,
        state_dir=tmp_path,
    )
    with pytest.raises(RuntimeUnavailableError):
        await app.run(lambda *_: None)
    expected = [TASK_SETS + place] if place else []
    assert [text.partition(" without")[0] for text in warnings(caplog)] == expected


@pytest.mark.parametrize(
    ("public_url", "text"),
    [("ws://r/", "robots' passwords and messages travel"), ("wss://r/", "messages between task sets")],
)
async def test_robot_task_set_warns_of_what_is_in_clear(
    public_url: str, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert [one[: len(text)] for one in await warnings_of_robot(TlsChoice(), caplog, public_url)] == [text]


async def test_robot_task_set_with_own_certificate_warns(
    clients_only: TlsChoice, caplog: pytest.LogCaptureFixture
) -> None:
    (text,) = await warnings_of_robot(clients_only, caplog)
    assert text.startswith(TASK_SETS + "0.0.0.0")


async def warnings_of_robot(
    tls: TlsChoice, caplog: pytest.LogCaptureFixture, public_url: str = ""
) -> list[str]:
    settings = RobotSettings(
        host="0.0.0.0", ws_port=0, link_port=0, public_host="127.0.0.1", public_url=public_url
    )
    app = RobotApp(master="127.0.0.1", control_port=1, secret=SECRET, packages=(), settings=settings, tls=tls)
    async with app.started(lambda _: None):
        return warnings(caplog)


@pytest.mark.parametrize("etcd", [None, EtcdAddress(("127.0.0.1:2379",))], ids=["alone", "stand-by"])
async def test_master_warns_at_its_start_if_it_stands_by_too(
    etcd: EtcdAddress | None,
    clients_only: TlsChoice,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A stand-by passes clients' requests on, and takes their passwords for that."""

    async def run(*_: object) -> None:
        pass

    monkeypatch.setattr(Master, "run", run)
    monkeypatch.setattr(ReplicatedMaster, "run", run)
    for tls in (TlsChoice(), clients_only, TlsChoice(enabled=True)):
        await run_master(MasterSettings(bind="0.0.0.0", state_dir=tmp_path / "s", etcd=etcd, tls=tls), SECRET)
    first, second = warnings(caplog)
    assert first.startswith("passwords travel in clear: this listens on 0.0.0.0")
    assert second.startswith(TASK_SETS + "0.0.0.0")
