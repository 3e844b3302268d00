"""A robot's file as ``rce-ros`` reads it; types that it leaves out are read from the robot's ROS graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.config.client import ClientConfig, loads
from rce_client.ros_bridge.bridge import joined_graph
from rce_client.ros_bridge.plan import check
from rce_client.ros_bridge.type_lookup import find_types

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.node import Node
    from rce.ros.types import TypeRegistry


class RobotFile:
    """A robot's file in which types of bridges may be missing.

    Args:
        source: Name of the file, for errors.
        text: Content of the file.
        types: The message types that are known here.

    Attributes:
        draft: The file without the bridges whose types are to be found out.

    Raises:
        ConfigError: The file is not valid.
    """

    def __init__(self, source: str, text: str, types: TypeRegistry) -> None:
        self.types = types
        self._source = source
        self._text = text
        self.draft = loads(text, source, draft=True)
        check(self.draft, types, source)

    async def resolve(self, master_uri: str, say: Callable[[str], None]) -> ClientConfig:
        """Return the complete file; ask the robot's graph for missing types.

        Raises:
            ConfigError: A type cannot be read, or does not fit.
        """
        if not self.draft.untyped:
            return self.draft
        async with joined_graph(self.draft.robot, master_uri, self.types, say) as node:
            return await self.complete(node, say)

    async def complete(self, node: Node, say: Callable[[str], None]) -> ClientConfig:
        """Return the complete file; ask the robot's graph for missing types, by a node that is in it.

        Raises:
            ConfigError: A type cannot be read, or does not fit.
        """
        if not self.draft.untyped:
            return self.draft
        found = await find_types(self.draft.untyped, node, self._source, say)
        config = loads(self._text, self._source, types=found)
        check(config, self.types, self._source)
        return config
