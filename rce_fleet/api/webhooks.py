"""Models of webhooks below ``/api/v1/webhooks``, and their signature."""

from __future__ import annotations

import hashlib
import hmac
from typing import Literal

from pydantic import Field

from rce_fleet.api.tasks import ApiModel

SIGNATURE, TIMESTAMP, WEBHOOK = "RCE-Signature", "RCE-Timestamp", "RCE-Webhook"
"""Headers of a delivery."""
MAX_AGE_S = 300.0
"""Seconds after which a receiver takes a delivery for a replay."""
_DIGITS = 15
"""Of a timestamp at most: Python refuses to read numbers of some thousands."""


EventKind = Literal["task", "robot", "goal", "fleet", "planner", "places", "zone", "cells"]


class WebhookRequest(ApiModel):
    """A receiver of events."""

    url: str = Field(description="Where events are sent: http or https.", max_length=2000)
    secret: str = Field(
        default="", description="Key of the signature; empty: one is made and returned once.", max_length=200
    )
    kinds: list[EventKind] = Field(
        default_factory=list,
        description="Kinds of events; empty: all.",
        max_length=20,
    )
    allow_private: bool = Field(
        default=False, description="Whether the receiver may be on this machine or in a private network."
    )


class WebhookModel(ApiModel):
    """A receiver of events, and how far it is."""

    id: str
    url: str
    kinds: list[str]
    allow_private: bool
    created_by: str
    position: int = Field(description="Number of the last event that is done.")
    failures: int = Field(description="Failed deliveries in a row.")
    error: str = Field(description="Why the last delivery failed; empty: it did not.")
    next_attempt: float | None = Field(description="When it is tried again, seconds since 1970.")


class NewWebhookModel(WebhookModel):
    """A new receiver, with its secret."""

    secret: str = Field(description="Key of the signature; it is not shown again.")


class WebhookList(ApiModel):
    """All receivers."""

    webhooks: list[WebhookModel]


def sign(secret: str, timestamp: str, body: bytes) -> str:
    """Return the signature of a delivery: ``v1=`` and HMAC-SHA256 of ``timestamp.body`` in hex."""
    digest = hmac.new(secret.encode(), timestamp.encode() + b"." + body, hashlib.sha256)
    return f"v1={digest.hexdigest()}"


def verify(secret: str, timestamp: str, body: bytes, signature: str, *, now: float) -> bool:
    """Whether a delivery is genuine and new.

    Args:
        secret: The webhook's secret.
        timestamp: The header ``RCE-Timestamp``, seconds since 1970.
        body: The body, untouched.
        signature: The header ``RCE-Signature``.
        now: Seconds since 1970.
    """
    if not timestamp.isdecimal() or len(timestamp) > _DIGITS or abs(now - int(timestamp)) > MAX_AGE_S:
        return False
    given = signature.encode(errors="surrogatepass")
    return hmac.compare_digest(sign(secret, timestamp, body).encode(), given)
