"""Webhooks: signatures, where events may be sent, and what is kept."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
from pydantic import ValidationError

from rce_fleet.api.webhooks import EventKind, WebhookRequest, sign, verify
from rce_fleet.exceptions import RequestRefusedError
from rce_fleet.station.webhook_sender import PublicResolver
from rce_fleet.station.webhook_store import MAX_WEBHOOKS, WebhookStore, check_url, webhooks_file
from rce_fleet.tasks.records import RECORD_TYPES

BODY = b'{"events": []}'


def test_a_signature_covers_time_and_body() -> None:
    signature = sign("secret", "1000", BODY)
    assert verify("secret", "1000", BODY, signature, now=1000.0)
    assert verify("secret", "1000", BODY, signature, now=1299.0)
    for wrong in (
        verify("other", "1000", BODY, signature, now=1000.0),
        verify("secret", "1001", BODY, signature, now=1000.0),
        verify("secret", "1000", BODY + b" ", signature, now=1000.0),
        verify("secret", "1000", BODY, signature, now=1301.0),
        verify("secret", "soon", BODY, signature, now=1000.0),
        verify("secret", "9" * 5000, BODY, signature, now=1000.0),
        verify("secret", "1000", BODY, "v1=ä", now=1000.0),
        verify("secret", "1000", BODY, "v1=\udce4", now=1000.0),  # as aiohttp reads a byte that is not UTF-8
    ):
        assert not wrong


@pytest.mark.parametrize(
    "url",
    [
        *(
            "ftp://example.com/x",
            "file:///etc/passwd",
            "example.com",
            "https://",
            "http://[::1",
            "http://a:b/",
        ),
        *(
            "https://name:password@example.com/",
            "http://localhost/x",
            "http://127.0.0.1/",
            "http://10.0.0.8:80/x",
        ),
        *("http://[::1]/", "http://169.254.169.254/latest", "http://192.168.1.1/", "http://0.0.0.0/"),
        # Digits and dots that the HTTP client reads as those of 127.0.0.1
        *("http://127\u30020\u30020\u30021/", "http://\uff11\uff12\uff17.0.0.1/", "http://127\uff0e0.0.1/"),
        *(
            "http://127.0.0.1./",
            "http://localhost./",
            "http://LOCALHOST/",
            "http://127.1/",
            "http://2130706433/",
        ),
        # IPv6 addresses that carry an IPv4 address
        *("http://[64:ff9b::7f00:1]/", "http://[64:ff9b::10.0.0.8]/", "http://[2002:7f00:1::]/"),
        *(
            "http://[2002:c0a8:101::1]/",
            "http://[::ffff:127.0.0.1]/",
            "http://[64:ff9b:1::1]/",
            "http://[::7f00:1]/",
        ),
        "http://[fe80::1%25eth0]/",
    ],
)
def test_urls_that_are_refused(url: str) -> None:
    with pytest.raises(RequestRefusedError):
        check_url(url, allow_private=False)


def test_private_urls_need_to_be_allowed() -> None:
    for url in ("http://127.0.0.1:9/x", "https://localhost/", "http://192.168.1.1/"):
        check_url(url, allow_private=True)
    for url in (
        "https://erp.example.com/fleet?x=1",
        "http://[64:ff9b::8.8.8.8]/",
        "http://[2002:808:808::1]/",
        "http://[::ffff:8.8.8.8]/",
    ):
        check_url(url, allow_private=False)


async def test_a_name_of_a_private_address_is_refused() -> None:
    """The name is looked up at each delivery, so that a later change is noticed too."""
    with pytest.raises(OSError, match="private network"):
        await PublicResolver().resolve("localhost", 80)


def test_webhooks_are_kept_where_only_the_owner_reads(tmp_path: Path) -> None:
    file = tmp_path / "station" / "webhooks.json"
    store = WebhookStore(file)
    store.load()
    made = store.add(WebhookRequest(url="https://example.com/", kinds=["task"]), "anna", 7)
    assert len(made.secret) > 30
    assert made.secret not in repr(made)
    made.position, made.failures = 12, 2
    store.save()
    assert file.stat().st_mode & 0o077 == 0
    again = WebhookStore(file)
    again.load()
    (kept,) = again
    assert (kept.position, kept.failures, kept.secret, kept.kinds) == (12, 2, made.secret, ("task",))
    assert again.remove(made.id)
    assert not again.remove(made.id)


def loaded(folder: Path, fleet: str) -> WebhookStore:
    store = WebhookStore(webhooks_file(folder, fleet))
    store.load()
    return store


def urls(store: WebhookStore) -> list[str]:
    return [webhook.url for webhook in store]


def test_each_fleet_has_webhooks_of_its_own(tmp_path: Path) -> None:
    """The stations of a machine share a folder: each wrote its own list over that of the others."""
    stores = {fleet: loaded(tmp_path, fleet) for fleet in ("hall 1", "hall 2")}
    for fleet, store in stores.items():
        store.add(WebhookRequest(url=f"https://example.com/{fleet[-1]}"), "anna", 0)
        store.save()
    assert [urls(loaded(tmp_path, fleet)) for fleet in stores] == [
        ["https://example.com/1"],
        ["https://example.com/2"],
    ]


def test_webhooks_of_a_file_for_all_fleets_go_to_the_first_one(tmp_path: Path) -> None:
    """As an earlier release kept them, of a station that usually was the only one."""
    former = WebhookStore(tmp_path / "webhooks.json")
    former.add(WebhookRequest(url="https://example.com/"), "anna", 0)
    former.save()
    assert urls(loaded(tmp_path, "hall 1")) == ["https://example.com/"]
    assert urls(loaded(tmp_path, "hall 2")) == []
    assert urls(loaded(tmp_path, "hall 1")) == ["https://example.com/"]


def test_a_fleet_under_another_url_is_told_of_its_webhooks_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = loaded(tmp_path, "http://here/ hall 1")
    assert caplog.text == "", "there are none"
    before.add(WebhookRequest(url="https://example.com/"), "anna", 0)
    before.save()
    for _ in range(2):
        assert urls(loaded(tmp_path, "https://here/ hall 1")) == []
    name = webhooks_file(tmp_path, "https://here/ hall 1").name
    assert caplog.text.count(f"rename that file to {name}") == 1


def test_a_kind_that_no_event_has_is_refused() -> None:
    """A receiver of ``tasks`` got nothing, without a word."""
    assert get_args(EventKind) == tuple(RECORD_TYPES)
    with pytest.raises(ValidationError, match=r"kinds\.0"):
        WebhookRequest.model_validate({"url": "https://example.com/", "kinds": ["tasks"]})


def test_there_are_at_most_so_many() -> None:
    store = WebhookStore(None)
    for _ in range(MAX_WEBHOOKS):
        store.add(WebhookRequest(url="https://example.com/"), "anna", 0)
    with pytest.raises(RequestRefusedError, match="20 webhooks already"):
        store.add(WebhookRequest(url="https://example.com/"), "anna", 0)
