"""The definitions of fkie's messages that ship with the package, and which are used."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rce.ros.multimaster import messages
from rce.ros.multimaster.heartbeat import Stamp
from rce.ros.multimaster.peer_table import Neighbour, PeerChange, PeerEvent

SHARE = Path(messages.__file__).with_name("share") / messages.PACKAGE
MASTER = Neighbour(
    "b", "http://b:11311/", "http://b:11611/", "/master_discovery", True, Stamp(1, 2), Stamp(3, 4)
)


@pytest.mark.parametrize(
    ("name", "md5sum"),
    [
        (messages.MASTER_STATE, "d25ba81effb888c4150d378d8adedb03"),
        (messages.LINK_STATES, "36d101076ab31009020bc3d52fdd6264"),
    ],
)
def test_checksums_are_those_of_releases_since_1_1_0(name: str, md5sum: str) -> None:
    """The sums are of fkie's releases; rosbags makes the same of the text."""
    assert messages.registry().message(name).md5sum == md5sum
    store = get_typestore(Stores.ROS1_NOETIC)
    for file in (SHARE / "msg").glob("*.msg"):
        store.register(get_types_from_msg(file.read_text(), f"{messages.PACKAGE}/msg/{file.stem}"))
    assert store.generate_msgdef(name.replace("/", "/msg/"))[1] == md5sum


@pytest.mark.parametrize("change", list(PeerChange))
def test_states_are_written_plainly_and_read_with_quotes_too(change: PeerChange) -> None:
    event = PeerEvent(change, MASTER)
    kind = messages.registry().message(messages.MASTER_STATE)
    written = kind.deserialize(kind.serialize(messages.master_state(event)))
    assert written.state == change.value
    assert messages.read_master_state(written) == event
    written.state = f"'{written.state}'"
    assert messages.read_master_state(written) == event


def test_installed_messages_before_1_1_0_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Their ``ROSMaster`` has other fields: a discovery could write none."""
    folder = tmp_path / messages.PACKAGE
    shutil.copytree(SHARE, folder)
    file = folder / "msg" / "ROSMaster.msg"
    file.write_text(file.read_text().replace("time last_change", "float64 timestamp"))
    monkeypatch.setenv("RCE_PACKAGE_PATH", str(tmp_path))
    with caplog.at_level(logging.WARNING):
        assert messages.registry().message(messages.MASTER_STATE).md5sum == "d25ba81effb888c4150d378d8adedb03"
    assert "1.1.0 or later" in caplog.text


def test_installed_messages_since_1_1_0_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A later definition may have more fields."""
    folder = tmp_path / messages.PACKAGE
    shutil.copytree(SHARE, folder)
    with (folder / "msg" / "LinkState.msg").open("a") as file:
        file.write("uint8 more\n")
    monkeypatch.setenv("RCE_PACKAGE_PATH", str(tmp_path))
    links = messages.registry().message(messages.LINK_STATES)
    assert links.md5sum != "36d101076ab31009020bc3d52fdd6264"
