"""``rosout.log`` of our core and of a real one: in the same place, with the same lines."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from support.ports import free_port
from support.ros_nodes import MakeGraphNode
from support.ros_real import Graph

pytestmark = [pytest.mark.needs("rospy", "roslaunch")]

OURS = str(Path(sys.executable).parent / "rce")
ROSPY = """
import rospy
rospy.init_node("talker")
rospy.logwarn("from rospy")
rospy.spin()
"""


def log_of(home: Path) -> str:
    return "".join(path.read_text() for path in home.glob(".ros/log/*-*/rosout.log"))


async def written(kind: str, make_node: MakeGraphNode, home: Path) -> dict[str, str]:
    """Have a node of ours and a rospy one log; return their lines, by node, without times."""
    port = free_port()
    home.mkdir()
    graph = Graph(f"http://127.0.0.1:{port}/", home, kind)
    argv = [OURS, "core", "--port", str(port)] if kind == "ours" else ["/usr/bin/roscore", "-p", str(port)]
    script = home / "talker.py"
    script.write_text(ROSPY)
    async with graph.program(*argv, node="/rosout"), make_node(graph, "ours") as node:
        node.log.error("from ours")
        async with graph.program("/usr/bin/python3", str(script), node="/talker"):

            async def all_there() -> bool:
                return {"from ours", "from rospy"} <= set(re.findall(r"from \w+", log_of(home)))

            await graph.until(all_there, what="both records are in the file")
        text = log_of(home)
        assert (home / ".ros" / "log" / "latest" / "rosout.log").read_text().startswith(text[:100])
    assert re.match(r"\n\n\d+\.\d{9}  Node Startup\n", text)
    lines = [re.fullmatch(r"\d+\.\d+ (\w+ (/\w+) .*)", line) for line in text.splitlines() if "from " in line]
    return {line[2]: _sorted_topics(line[1]).replace(str(home), "HOME") for line in lines if line}


def _sorted_topics(line: str) -> str:
    return re.sub(r"\[topics: (.*?)\]", lambda found: str(sorted(found[1].split(", "))), line)


async def test_the_file_is_the_same(make_node: MakeGraphNode, tmp_path: Path) -> None:
    real = await written("roscore", make_node, tmp_path / "real")
    ours = await written("ours", make_node, tmp_path / "ours")
    assert real.keys() == {"/ours", "/talker"}
    assert ours == real
