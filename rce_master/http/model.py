"""What the API's models have in common."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """A body. What validates and writes it is built at its first use: most masters use few of them."""

    model_config = ConfigDict(defer_build=True)


class Body(Model):
    """Base of what is sent to the API; an unknown key is a mistake."""

    model_config = ConfigDict(extra="forbid", strict=True)
