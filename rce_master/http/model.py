"""The base classes of the API's models."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """A body. Its validator and serializer are built at its first use: most masters use few models."""

    model_config = ConfigDict(defer_build=True)


class Page(Model):
    """Base of answers that are a page of a list, or the whole list."""

    next: str | None = None
    """The cursor of the next page; null: there is none."""


class Body(Model):
    """Base of request bodies; rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True)
