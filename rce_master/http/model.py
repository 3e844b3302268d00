"""The base classes of the API's models."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """A body. Its validator and serializer are built at its first use: most masters use few models."""

    model_config = ConfigDict(defer_build=True)


class Body(Model):
    """Base of request bodies; rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True)
