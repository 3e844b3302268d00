"""What a node knows of parameters by updates is what the core holds."""

from __future__ import annotations

import asyncio
from typing import Any

from hypothesis import example, given
from hypothesis import strategies as st

from rce.ros.core.graph import Graph
from rce.ros.node.master import MasterClient
from rce.ros.node.parameters import Parameters
from rce.ros.xmlrpc import RpcClient

URI = "http://127.0.0.1:1/"
NAMES = st.lists(st.sampled_from("abc"), min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
VALUES = st.recursive(
    st.integers(0, 3), lambda inner: st.dictionaries(st.sampled_from("abc"), inner, min_size=1, max_size=2)
)
CHANGES = st.tuples(NAMES, st.none() | VALUES, st.booleans())


class GraphMaster(MasterClient):
    """A master in the same process."""

    graph: Graph

    async def call(self, method: str, *arguments: Any) -> Any:
        match method, arguments:
            case "subscribeParam", (uri, name):
                return self.graph.subscribe_parameter(name, self.caller, uri)[0]
            case "setParam", (name, value):
                self.graph.set_parameter(name, value, by=self.caller)
            case "deleteParam", (name,):
                self.graph.delete_parameter(name)
            case _:
                pass  # the graph need not know
        return 0


def plain(value: object) -> Any:
    """A tree without the empty namespaces that deleting may leave: they count as not set."""
    if not isinstance(value, dict):
        return value
    return {key: inner for key, item in value.items() if (inner := plain(item)) != {}}


@example(watched=["/a", "/a/a"], changes=[("/a", 0, False)])
@given(watched=st.lists(NAMES, min_size=1, max_size=3), changes=st.lists(CHANGES, max_size=12))
def test_the_cache_follows_the_core(watched: list[str], changes: list[tuple[str, Any, bool]]) -> None:
    graph = Graph()
    master = GraphMaster("http://core:1/", "/node", URI, RpcClient())
    master.graph = graph
    cache = Parameters(master)

    async def play() -> None:
        for name in watched:
            await cache.get_cached(name, None)
        for name, value, by_node in changes:
            if value is None:
                if not graph.parameters.has(name):
                    continue
                outcome = graph.delete_parameter(name)
            elif by_node:
                await cache.set(name, value)
                continue
            else:
                outcome = graph.set_parameter(name, value, by="/other")
            for call in outcome.calls:
                cache.changed(*call.arguments)
        for name in watched:
            held = graph.parameters.get(name) if graph.parameters.has(name) else {}
            assert plain(await cache.get_cached(name, {})) == plain(held)

    asyncio.run(play())
