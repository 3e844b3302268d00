"""``rce logs``: what it asks for, and what it does when a container ends."""

from __future__ import annotations

from typing import Any, Self

import pytest

from rce.control.logs import LogLevel
from rce_master.cli import credentials, follow
from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import ApiError, CliError


class Server:
    """Has the logs of a container's lives, one after the other; a life continues while it is the last."""

    def __init__(self, **lives: str) -> None:
        self.lives = lives
        self.queries: list[dict[str, Any]] = []
        self.urls: list[str] = []
        self.born_later: dict[str, str] = {}
        self.reads_left = 100
        self.faults: dict[int, CliError] = {}
        """By the numbers of the requests that they answer."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None: ...

    async def call(self, method: str, url: str, query: dict[str, Any]) -> dict[str, Any]:
        assert method == "GET"
        self.urls.append(url)
        self.queries.append(query)
        if fault := self.faults.get(len(self.queries)):
            raise fault
        if not self.reads_left:
            raise ApiError(401, "enough")
        self.reads_left -= 1
        names = list(self.lives)
        life = query.get("life") or names[-2 if query.get("previous") else -1]
        is_over = life != names[-1] or self.born_later
        text = self.lives[life][query.get("offset", 0) :][:3]
        offset = query.get("offset", 0) + len(text)
        if is_over and not text and self.born_later:
            self.lives |= self.born_later
            self.born_later = {}
        ended = 1.0 if is_over else None
        return {"text": text, "offset": offset, "life": life, "ended": ended, "reason": "out of memory"}


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Server:
    server = Server(one="first life", two="second life")
    monkeypatch.setattr(credentials, "load", lambda: None)
    monkeypatch.setattr(ApiClient, "of", lambda _: server)
    monkeypatch.setattr(follow, "POLL_S", 0.0)
    return server


async def test_a_log_is_printed_to_its_end(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    await follow._logs("c/n", follow=False, offset=0, query={})
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("second life", "")
    assert set(server.urls) == {"/containers/c/nodes/n/log"}
    assert [query.get("life") for query in server.queries] == [None, "two", "two", "two", "two"]


async def test_an_earlier_life_says_how_it_ended(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    await follow._logs("c", follow=False, offset=0, query={"previous": "true"})
    captured = capsys.readouterr()
    assert captured.out == "first life"
    assert captured.err.count("out of memory") == 1
    assert "incarnation one ended" in captured.err


async def test_following_goes_on_with_the_next_life(
    server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    server.born_later = {"three": "third life"}
    server.reads_left = 20
    with pytest.raises(ApiError, match="enough"):
        await follow._logs("c/n", follow=True, offset=0, query={"stream": "stdout"})
    captured = capsys.readouterr()
    assert captured.out == "second lifethird life"
    assert captured.err.count("-- the container's incarnation two ended") == 1


async def test_following_continues_after_the_masters_restart(
    server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    """At the log's end too, where it asks whether the container was started again."""
    refused = CliError("cannot use the master: connection refused")
    server.faults = {2: refused, 3: ApiError(502, "bad gateway"), 7: refused, 9: refused, 11: refused}
    server.lives = {"one": "first life"}
    server.reads_left = 20
    with pytest.raises(ApiError, match="enough"):
        await follow._logs("c/n", follow=True, offset=0, query={})
    assert capsys.readouterr().out == "first life"


@pytest.mark.parametrize(("follows", "fault"), [(True, 1), (False, 2)])
async def test_master_that_is_away_ends_the_command(server: Server, follows: bool, fault: int) -> None:
    """A master that was never reached is not waited for, and neither is any without ``--follow``."""
    server.faults = {fault: CliError("connection refused")}
    with pytest.raises(CliError, match="refused"):
        await follow._logs("c/n", follow=follows, offset=0, query={})


def test_options_become_a_query(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follow, "_logs", lambda *arguments: arguments)
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(follow, "run", asked.append)
    follow.logs("c/n", bytes_=100, stderr=True, level=LogLevel.WARN, previous=True)
    follow.logs("c/n")
    assert asked == [
        ("c/n", False, -100, {"stream": "stderr,rosout", "level": "warn", "previous": "true"}),
        ("c/n", False, 0, {}),
    ]
