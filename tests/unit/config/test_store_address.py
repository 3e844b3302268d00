from __future__ import annotations

from pathlib import Path

import pytest

from rce.config import (
    MASTER_FOLDER,
    STORE_FILE,
    EngineSettings,
    EtcdAddress,
    MasterSettings,
    SqliteAddress,
    read_store_address,
)


def test_an_address_of_etcd_has_endpoints_prefix_and_tls() -> None:
    assert read_store_address("etcd://10.0.0.1") == EtcdAddress(("10.0.0.1:2379",), "/rce", tls=False)
    found = read_store_address("etcds://a:1, b-c.example:2,[::1]:3/fleet/two/")
    assert found == EtcdAddress(("a:1", "b-c.example:2", "[::1]:3"), "/fleet/two", tls=True)
    assert read_store_address(str(found)) == found
    assert found.hosts == ("a", "b-c.example", "::1")


def test_an_address_of_sqlite_is_a_folder() -> None:
    assert read_store_address("") == read_store_address("sqlite:") == SqliteAddress(None)
    assert read_store_address("sqlite:/var/lib/x") == SqliteAddress(Path("/var/lib/x"))
    settings = EngineSettings(state_dir=Path("/s"), master=MasterSettings(store="sqlite:/var/lib/x"))
    assert settings.master_state == Path("/var/lib/x")
    etcd = EngineSettings(state_dir=Path("/s"), master=MasterSettings(store="etcd://one"))
    assert etcd.master_state == Path("/s/master")


def test_a_state_in_a_named_folder_is_where_commands_made_it(tmp_path: Path) -> None:
    """``rce master copy --to sqlite:FOLDER`` makes a new state in ``FOLDER/master``."""
    settings = EngineSettings(master=MasterSettings(store=f"sqlite:{tmp_path}"))
    assert settings.master_state == tmp_path
    inner = tmp_path / MASTER_FOLDER
    inner.mkdir()
    (inner / STORE_FILE).touch()
    assert settings.master_state == inner
    (tmp_path / STORE_FILE).touch()
    assert settings.master_state == tmp_path


@pytest.mark.parametrize(
    "text",
    [
        *("etcd:", "etcd://", "etcd://a,,b", "etcd://a:0", "etcd://a:70000", "etcd://u:p@a", "http://a"),
        *("a:2379", "etcd://a/ b", "etcd://a//b", "etcd://a/../b?x=1"),
    ],
)
def test_other_addresses_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="must"):
        read_store_address(text)
