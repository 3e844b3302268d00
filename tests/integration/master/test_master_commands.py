"""The commands' client and tables against a real master."""

from __future__ import annotations

import asyncio
import io
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from rce.control.messages import Put
from rce_master.cli import follow, show
from rce_master.cli.client import ApiClient
from rce_master.cli.credentials import FILE_VARIABLE, Credentials, load, save
from rce_master.cli.exceptions import ApiError, CliError, NotLoggedInError

if TYPE_CHECKING:
    from pathlib import Path

    from integration.master.conftest import Site


def printed(renderable: object) -> str:
    console = Console(file=io.StringIO(), width=160)
    console.print(renderable)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


async def test_the_client_says_what_the_master_said(site: Site) -> None:
    async with ApiClient(site.url, site.token) as client:
        with pytest.raises(ApiError, match="there is no container 'c'") as caught:
            await client.call("DELETE", "/containers/c")
        assert caught.value.status == 404
    async with ApiClient("http://127.0.0.1:1/", "x") as client:
        with pytest.raises(CliError, match="cannot use the master"):
            await client.call("GET", "/user")


async def test_of_several_masters_the_client_asks_one_that_answers(site: Site) -> None:
    async with ApiClient(f"http://127.0.0.1:1/,{site.url}", site.token) as client:
        assert (await client.call("GET", "/user"))["name"] == "testUser"
    async with ApiClient(f"http://127.0.0.1:1/,{site.url}", site.token) as client, asyncio.timeout(30):
        following = client.events()
        await client.call("POST", "/containers", {"tag": "c"})
        assert (await anext(following)).kind
    async with ApiClient("http://127.0.0.1:1/,http://127.0.0.1:2/", "x") as client:
        with pytest.raises(CliError, match="cannot use the master"):
            await client.call("GET", "/user")


async def test_events_go_on_where_they_were(site: Site) -> None:
    async with ApiClient(site.url, site.token) as client:
        await client.call("POST", "/containers", {"tag": "c"})
        events = client.events(since=0)
        kinds = [(await anext(events)).kind for _ in range(2)]
        await client.call("DELETE", "/containers/c")
        kinds.append((await anext(events)).kind)
        assert isinstance(events, AsyncGenerator)
        await events.aclose()
    assert kinds == ["user_added", "container_requested", "container_destroyed"]


async def test_a_master_that_is_away_is_one_plain_error() -> None:
    async with ApiClient("http://127.0.0.1:1/", "x") as client:
        with pytest.raises(CliError, match="cannot use the master at"):
            await show.fetch(client, "robots", "containers")


async def test_ps_shows_what_there_is(site: Site) -> None:
    async with site.containers() as containers, ApiClient(site.url, site.token) as client:
        await client.call("POST", "/containers", {"tag": "c"})
        await client.call("POST", "/containers/c/nodes", {"tag": "n", "pkg": "Test", "exe": "x.py"})
        await containers.get(Put)
        names = ("machines", "containers", "robots", "nodes", "connections")
        text = printed(show._overview(await show.fetch(client, *names)))
        assert "testUser/c" in text
        assert "Test/x.py" in text
        assert "draining" not in text
        await client.call("PUT", "/machines/c1/drain")
        assert "machine (draining)" in printed(show._overview(await show.fetch(client, *names)))


async def test_logs_are_printed_whole(
    site: Site, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "deep" / "login.json"))
    with pytest.raises(NotLoggedInError):
        load()
    save(Credentials(url=site.url, user="testUser", token=site.token, expires=0.0))
    assert site.token not in repr(load())
    async with site.containers() as containers:
        containers.log = b"0123456789" * 20_000
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        await follow._logs("c", follow=False, offset=0, query={})
    assert capsys.readouterr().out == "0123456789" * 20_000
