"""``rce events`` at masters that come and go."""

from __future__ import annotations

import msgspec
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer

from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import ApiError
from rce_master.events import Event


class Masters:
    """Answers requests for events: each in its turn by a number of events, or by a status."""

    def __init__(self, *answers: int) -> None:
        self._answers = list(answers)
        self.since: list[str] = []
        """The last event that each request named."""

    async def answer(self, request: web.Request) -> web.StreamResponse:
        self.since.append(request.headers.get("Last-Event-ID", ""))
        given = self._answers.pop(0)
        if given >= 400:
            return web.json_response({"error": "no master leads"}, status=given)
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await response.prepare(request)
        first = int(self.since[-1] or 0) + 1
        await response.write(b"id: %d\n: hello\n\n" % (first - 1))
        for number in range(first, first + given):
            event = Event(id=number, time=1.0, kind="node_started", user="u", subject="u/c")
            await response.write(b"data: " + msgspec.json.encode(event) + b"\n\n")
        return response


async def follow(masters: Masters, count: int) -> list[int]:
    app = web.Application()
    app.router.add_get("/api/v1/events", masters.answer)
    found: list[int] = []
    async with TestServer(app) as server, ApiClient(str(server.make_url("/"))) as client:
        async for event in client.events():
            found.append(event.id)
            if len(found) == count:
                break
    return found


async def test_a_stream_outlives_a_time_without_a_leader() -> None:
    masters = Masters(2, 503, 502, 2)
    assert await follow(masters, 4) == [1, 2, 3, 4]
    assert masters.since == ["", "2", "2", "2"]


async def test_a_stream_without_events_is_resumed_where_it_began() -> None:
    masters = Masters(0, 503, 1)
    assert await follow(masters, 1) == [1]
    assert masters.since == ["", "0", "0"]


@pytest.mark.parametrize("answers", [(503,), (2, 401)])
async def test_other_refusals_end_it(answers: tuple[int, ...]) -> None:
    with pytest.raises(ApiError):
        await follow(Masters(*answers), 4)
