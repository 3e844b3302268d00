"""``param list|get|set|delete``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import yaml

from rce.ros.errors import ToolError
from rce.ros.tools.plain import read_value

if TYPE_CHECKING:
    from rce.ros.tools.topics import ToolContext


async def list_parameters(context: ToolContext, namespace: str) -> None:
    """Print the names of all parameters in a namespace."""
    prefix = context.node.resolve(namespace).rstrip("/")
    for name in sorted(await context.node.get_param_names()):
        if name == prefix or name.startswith(f"{prefix}/"):
            context.show(name)


async def get(context: ToolContext, name: str, *, as_json: bool) -> None:
    """Print a parameter, or a whole namespace.

    Raises:
        ParameterMissingError: It is not set.
    """
    value = await context.node.get_param(name)
    if as_json:
        context.show(json.dumps(value, ensure_ascii=False, default=str))
    else:
        text = yaml.safe_dump(value, allow_unicode=True, default_flow_style=None)
        context.show(text.removesuffix("...\n").rstrip("\n"))


async def set_value(context: ToolContext, name: str, text: str) -> None:
    """Set a parameter to a YAML value; a mapping sets a whole namespace.

    Raises:
        ToolError: It is not a value that a parameter can have.
    """
    try:
        value = read_value(text)
    except ValueError as error:
        raise ToolError(str(error)) from error
    if value is None:
        raise ToolError(f"{text!r} is not a value; use 'param delete {name}' to delete the parameter")
    await context.node.set_param(name, value)


async def delete(context: ToolContext, name: str) -> None:
    """Delete a parameter or a namespace.

    Raises:
        ParameterMissingError: It is not set.
    """
    await context.node.delete_param(name)
