"""Interface types at the two ends of a link's connection."""

from __future__ import annotations

TOPIC_OUT = ("SubscriberConverter", "PublisherInterface")
TOPIC_IN = ("PublisherConverter", "SubscriberInterface")
SERVICE_OUT = ("ServiceProviderForwarder", "ServiceClientInterface")
