"""Requests to the fleet's HTTP API: models in, models out."""

from __future__ import annotations

import ssl
from typing import TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from rce_fleet.client.errors import FleetApiUnavailableError
from rce_fleet.client.transport import Transport

M = TypeVar("M", bound=BaseModel)


class ApiRequests:
    """Sends requests to a station, and reads the models of its answers.

    Args:
        url: URL of the station.
        token: Bearer token; empty for a station without logins.
        tls: Checks the station's certificate; None for the authorities that the system trusts.
        attempts: How often a request is sent that can be repeated.

    Raises:
        ValueError: The URL cannot be that of a station.
    """

    def __init__(
        self, url: str, token: str = "", *, tls: ssl.SSLContext | None = None, attempts: int = 6
    ) -> None:
        self._transport = Transport(url, token, tls=tls, attempts=attempts)

    async def _read(self, path: str, kind: type[M], query: dict[str, str] | None = None) -> M:
        return parsed(kind, await self._transport.request("GET", path, query=query))

    async def _change(
        self, method: str, path: str, kind: type[M], body: BaseModel | None, revision: int | None
    ) -> M:
        headers = if_match(revision)
        return await self._send(method, path, kind, body, headers=headers, repeatable=revision is None)

    async def _send(
        self,
        method: str,
        path: str,
        kind: type[M],
        body: BaseModel | None = None,
        *,
        headers: dict[str, str] | None = None,
        repeatable: bool = True,
    ) -> M:
        text = "" if body is None else body.model_dump_json(exclude_unset=True)
        answer = await self._transport.request(
            method, path, body=text, headers=headers, repeatable=repeatable
        )
        return parsed(kind, answer)


def if_match(revision: int | None) -> dict[str, str]:
    """Return the headers of a change to one revision; None: to any."""
    return {} if revision is None else {"If-Match": f'"{revision}"'}


def path_part(name: str) -> str:
    """Return a name as one part of a path."""
    return quote(name, safe="")


def parsed(kind: type[M], text: str) -> M:
    """Return the model in an answer.

    Raises:
        FleetApiUnavailableError: The answer is not of this model.
    """
    try:
        return kind.model_validate_json(text)
    except ValidationError as error:
        raise FleetApiUnavailableError(
            f"the station's answer is not a {kind.__name__}: {error.errors()[0]['msg']}; is the URL that of a"
            " station, and of the same release?"
        ) from error
