"""The interfaces of a robot's own, as methods that make them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

from rce_client.ends import Publisher, ServiceClient, ServiceProvider, Subscriber

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce_client.ends import End, LatchListener, Way

E = TypeVar("E", bound="End")

Json = dict[str, Any]
"""A message as an object of its fields; binary values are bytes-like."""


class OwnInterfaces(ABC):
    """Makes a robot's publishers, subscribers, service clients and service providers."""

    @property
    @abstractmethod
    def _way(self) -> Way:
        """What the ends send through."""

    @abstractmethod
    async def _add_end(self, end: E) -> E:
        """Ask the engine for the interface of an end."""

    @overload
    async def publisher(self, tag: str, cls: str) -> Publisher[Json]: ...
    @overload
    async def publisher(self, tag: str, cls: str, *, raw: Literal[True]) -> Publisher[bytes]: ...
    async def publisher(self, tag: str, cls: str, *, raw: bool = False) -> Publisher[Any]:
        """Make an interface of this robot that sends messages.

        Args:
            tag: Interface tag.
            cls: Message class, ``package/Type``.
            raw: Messages are serialized ROS messages (a Forwarder) in place of objects (a Converter).
        """
        return await self._add_end(Publisher[Any](self._way, tag, cls, raw=raw))

    @overload
    async def subscriber(
        self,
        tag: str,
        cls: str,
        callback: Callable[[Json], Awaitable[None] | None] | None = None,
        *,
        queue_size: int = ...,
        latches: LatchListener[Json] | None = ...,
    ) -> Subscriber[Json]: ...
    @overload
    async def subscriber(
        self,
        tag: str,
        cls: str,
        callback: Callable[[bytes], Awaitable[None] | None] | None = None,
        *,
        raw: Literal[True],
        queue_size: int = ...,
        latches: LatchListener[bytes] | None = ...,
    ) -> Subscriber[bytes]: ...
    async def subscriber(
        self,
        tag: str,
        cls: str,
        callback: Callable[[Any], Awaitable[None] | None] | None = None,
        *,
        raw: bool = False,
        queue_size: int = 64,
        latches: LatchListener[Any] | None = None,
    ) -> Subscriber[Any]:
        """Make an interface of this robot that receives messages; see :class:`rce_client.ends.Subscriber`.

        Args:
            tag: Interface tag.
            cls: Message class, ``package/Type``.
            callback: Takes the messages.
            raw: As for :meth:`publisher`.
            queue_size: How many messages wait for an ``async`` callback, or for ``async for``.
            latches: Takes the latched messages in place of the callback, if the engine tells which they are.
        """
        return await self._add_end(
            Subscriber[Any](
                self._way, tag, cls, raw=raw, callback=callback, queue_size=queue_size, latches=latches
            )
        )

    @overload
    async def service_client(self, tag: str, cls: str) -> ServiceClient[Json]: ...
    @overload
    async def service_client(self, tag: str, cls: str, *, raw: Literal[True]) -> ServiceClient[bytes]: ...
    async def service_client(self, tag: str, cls: str, *, raw: bool = False) -> ServiceClient[Any]:
        """Make an interface of this robot that calls a service."""
        return await self._add_end(ServiceClient[Any](self._way, tag, cls, raw=raw))

    @overload
    async def service_provider(
        self, tag: str, cls: str, handler: Callable[[Json], Awaitable[Json] | Json], *, max_calls: int = ...
    ) -> ServiceProvider[Json]: ...
    @overload
    async def service_provider(
        self,
        tag: str,
        cls: str,
        handler: Callable[[bytes], Awaitable[bytes] | bytes],
        *,
        raw: Literal[True],
        max_calls: int = ...,
    ) -> ServiceProvider[bytes]: ...
    async def service_provider(
        self,
        tag: str,
        cls: str,
        handler: Callable[[Any], Awaitable[Any] | Any],
        *,
        raw: bool = False,
        max_calls: int = 64,
    ) -> ServiceProvider[Any]:
        """Make an interface of this robot that answers a service; what ``handler`` raises goes to callers."""
        return await self._add_end(
            ServiceProvider[Any](self._way, tag, cls, handler, raw=raw, max_calls=max_calls)
        )
