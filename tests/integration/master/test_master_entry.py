"""The clients' entry, health, metrics, origins: on real sockets."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pytest

from rce.control.messages import Usage
from rce.control.model import EndpointUsage, InterfaceUsage
from rce.protocol.http import CURRENT_VERSION
from rce_master.store import MemoryStore

if TYPE_CHECKING:
    from integration.master.conftest import RunSite, Site

GOOD = f"userID=testUser&version={CURRENT_VERSION}"


async def test_clients_are_sent_to_a_robot_process(site: Site) -> None:
    async with site.robots():
        async with site.session.get(f"{site.url}?{GOOD}") as reply:
            assert reply.status == 200
            assert reply.headers["Content-Type"] == "application/json; charset=utf-8"
            assert await reply.json() == {"url": "ws://r1:9010/"}
        async with site.session.get(f"{site.url}?userID=testUser&version=20130415") as reply:
            assert await reply.json() == {"url": "ws://r1:9010/", "current": CURRENT_VERSION}


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("", 400),
        ("userID=testUser", 400),
        (f"version={CURRENT_VERSION}", 400),
        (f"{GOOD}&userID=other", 400),
        (f"{GOOD}&version={CURRENT_VERSION}", 400),
        ("userID=testUser&version=new", 400),
        (f"userID=%2e%2e&version={CURRENT_VERSION}", 400),
        ("userID=testUser&version=20130414", 410),
        ("userID=testUser&version=20130903", 501),
        (GOOD, 503),
    ],
)
async def test_errors_are_plain_text(site: Site, query: str, status: int) -> None:
    async with site.session.get(f"{site.url}?{query}") as reply:
        assert reply.status == status
        assert reply.headers["Content-Type"].startswith("text/plain")
        assert await reply.text()


async def test_a_fleet_that_comes_at_once_is_spread(site: Site) -> None:
    async with site.robots("r1"), site.robots("r2"):
        urls: Counter[str] = Counter()
        for _ in range(10):
            async with site.session.get(f"{site.url}?{GOOD}") as reply:
                urls[(await reply.json())["url"]] += 1
        assert set(urls.values()) == {5}


async def test_the_least_loaded_is_handed_out(site: Site) -> None:
    async with site.robots("r1") as busy:
        digest = "3a1f" * 16
        await busy.channel.login("testUser", "rob", digest)
        from rce_master.auth import client_digest

        for number in range(3):
            reply = await busy.channel.login("testUser", f"rob{number}", client_digest("testUser"))
            assert reply.status == 200
        async with site.robots("r2"), site.session.get(f"{site.url}?{GOOD}") as reply_:
            assert (await reply_.json())["url"] == "ws://r2:9010/"


async def test_a_robot_process_that_left_is_not_handed_out(site: Site) -> None:
    async with site.robots():
        pass
    while True:
        async with site.session.get(f"{site.url}?{GOOD}") as reply:
            if reply.status == 503:
                return


async def test_health_and_metrics(site: Site) -> None:
    async with site.robots() as robots:
        async with site.session.get(f"{site.url}healthz") as reply:
            assert (await reply.json())["status"] == "ok"
        from rce_master.auth import client_digest

        await robots.channel.login("testUser", "rob", client_digest("testUser"))
        interface = {"tag": "i", "type": "SubscriberConverter", "cls": "std_msgs/String"}
        await site.api("POST", "/endpoints/rob/interfaces", interface, status=204)
        counters = InterfaceUsage(messages_in=7, bytes_out=11, dropped=3)
        robots.channel.send(
            Usage(
                cpu_s=1.5, memory=100, endpoints={"testUser/rob": EndpointUsage(interfaces={"i": counters})}
            )
        )
        while True:
            async with site.session.get(f"{site.url}metrics") as reply:
                text = await reply.text()
            # The report may come while metrics are made: those of task sets were before it then.
            if 'interface="i"} 7.0' in text and 'process="r1"} 100.0' in text:
                break
        assert 'rce_robots{session="connected"} 1.0' in text
        assert 'rce_messages_total{direction="in",endpoint="testUser/rob",interface="i"} 7.0' in text
        assert 'rce_messages_dropped_total{endpoint="testUser/rob",interface="i"} 3.0' in text
        assert 'rce_task_set_memory_bytes{kind="robot",process="r1"} 100.0' in text
        assert "process_resident_memory_bytes" in text


async def test_metrics_through_a_proxy_need_a_token(site: Site) -> None:
    """A token of an administrator, or one that is good for metrics and nothing else."""

    async def status(token: str = "", **headers: str) -> int:
        if token:
            headers["Authorization"] = f"Bearer {token}"
        async with site.session.get(f"{site.url}metrics", headers=headers) as reply:
            return reply.status

    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    robot = await site.api("POST", "/robot-tokens", {"robot": "R1"}, status=201)
    scoped = await site.api("POST", "/tokens", {"scope": "metrics"}, status=201)
    for name in ("X-Forwarded-For", "Forwarded", "X-Real-IP", "Via"):
        assert await status(**{name: "10.0.0.1"}) == 401
    assert await status(site.token, Via="1.1 proxy") == 200
    assert await status(scoped["token"], Via="1.1 proxy") == 200
    assert await status(robot["token"]) == 403
    assert await status(await site.login("anna", "one")) == 403
    assert await status("rce_guess") == 401
    await site.api("GET", "/user", token=scoped["token"], status=403)


async def test_metrics_outside_of_development_need_a_token(
    run_site: RunSite,
) -> None:
    """A proxy on the same machine need not say that it is one."""
    store = MemoryStore()
    async with run_site(store):
        pass  # made the user
    async with (
        run_site(store, dev=False) as site,
        site.session.get(f"{site.url}metrics") as reply,
    ):
        assert reply.status == 401


async def test_names_that_the_server_has_not_are_refused(
    run_site: RunSite,
) -> None:
    """DNS rebinding: the page's name leads here, and its Origin fits its Host."""
    async with run_site(public_names=("fleet.example",)) as site:
        port = site.url.rstrip("/").rpartition(":")[2]
        evil = f"evil.example:{port}"

        async def status(path: str, host: str, **headers: str) -> int:
            headers["Host"] = host
            async with site.session.get(f"{site.url}{path}", headers=headers) as reply:
                return reply.status

        assert await status("healthz", evil) == 421
        assert await status("metrics", evil) == 421
        assert await status("healthz", evil, Origin=f"http://{evil}") == 421
        assert await status(f"?{GOOD}", evil, Origin=f"http://{evil}") == 421
        assert await status(f"?{GOOD}", evil) == 503, "a robot finds its endpoint by any name"
        assert await status("healthz", f"fleet.example:{port}", Origin=f"http://fleet.example:{port}") == 200
        assert await status("healthz", f"localhost:{port}") == 200


async def test_pages_of_other_sites_are_refused(
    run_site: RunSite,
) -> None:
    async with run_site(allowed_origins=("https://fleet.example",)) as site:
        for origin, status in (
            ("https://evil.example", 403),
            ("null", 403),
            ("https://fleet.example", 200),
            (site.url.rstrip("/"), 200),
        ):
            async with site.session.get(f"{site.url}healthz", headers={"Origin": origin}) as reply:
                assert reply.status == status, origin


async def test_a_task_set_without_the_secret_stays_out(site: Site) -> None:
    import aiohttp

    url = f"http://127.0.0.1:{site.master.control_port}/"
    with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
        await site.session.ws_connect(url, headers={"Authorization": "Bearer wrong"})
    assert caught.value.status == 401
