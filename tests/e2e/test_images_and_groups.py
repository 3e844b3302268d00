"""A robot's containers with an image and in a group, through a whole engine."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from support.engine import running_engine
from support.rootfs import image_of, make_rootfs
from support.short_folders import PREFIX, TMP
from support.stranger import stranger

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.needs("root", "bwrap", "netns", "podman"),
]

STRING = "std_msgs/String"
REPEAT = """
from rce.ros.node import Node, run

async def main():
    async with Node("repeater", master_uri="http://inner:11311") as inner, Node("answerer") as own:
        answers = await own.advertise("answers", "std_msgs/String", latch=True)

        def repeat(message):
            answers.publish({"data": message.data})

        await inner.subscribe("stringEchoResp", "std_msgs/String", repeat)
        await own.spin()

run(main())
"""


async def test_robot_reaches_image_and_group() -> None:
    """A robot is heard in an image and answered through its group."""
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=TMP) as name:
        folder = Path(name)
        folder.chmod(0o755)
        make_rootfs(folder / "root")
        nodes = folder / "packages" / "own" / "nodes"
        nodes.mkdir(parents=True)
        (nodes.parent / "package.yaml").write_text("name: own\n")
        (nodes / "repeat.py").write_text(REPEAT)
        with image_of(folder / "root") as image:
            await _talk(image, folder / "packages")


def _container(tag: str, address: str, image: str = "") -> dict[str, object]:
    data = {"network": "group", "group": "g", "groupIp": address, "image": image}
    return {"containerTag": tag, "containerData": data}


def _interface(endpoint: str, tag: str, kind: str, addr: str = "") -> dict[str, str]:
    made = {"endpointTag": endpoint, "interfaceTag": tag, "interfaceType": kind, "className": STRING}
    return made | ({"addr": addr} if addr else {})


async def _talk(image: str, packages: Path) -> None:
    async with (
        running_engine(runtime="namespace", packages=packages, images=True) as engine,
        stranger(engine.url) as robot,
    ):
        await robot.send("CC", _container("inner", "10.1.0.1", image))
        await robot.send("CC", _container("outer", "10.1.0.2"))
        wanted = {
            "addNodes": [
                {"containerTag": "inner", "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py"},
                {"containerTag": "outer", "nodeTag": "repeat", "pkg": "own", "exe": "repeat.py"},
            ],
            "addInterfaces": [
                _interface("testRobot", "out", "SubscriberConverter"),
                _interface("inner", "out", "PublisherInterface", "stringEchoReq"),
                _interface("testRobot", "back", "PublisherConverter"),
                _interface("outer", "back", "SubscriberInterface", "answers"),
            ],
        }
        await robot.send("CN", wanted)
        pairs = [("testRobot/out", "inner/out"), ("testRobot/back", "outer/back")]
        await robot.send("CX", {"connect": [{"tagA": one, "tagB": other} for one, other in pairs]})
        await robot.wait_status({"out": True, "back": True}, timeout=30)
        await robot.publish("out", STRING, {"data": "through the image and the group"})
        answer = await robot.receive("back", timeout=30)
        assert answer["data"] == "through the image and the group"
        assert robot.errors == []


async def test_machine_that_offers_no_images_gets_none() -> None:
    """Podman works here, but its operator said ``--no-offer-images``."""
    async with running_engine() as engine, stranger(engine.url) as robot:
        machines = engine.get("/api/v1/machines")["machines"]
        (machine,) = [each for each in machines if each["kind"] == "container"]
        assert machine["runtimes"] == ["process"]
        await robot.send("CC", {"containerTag": "box", "containerData": {"image": "localhost/any:1"}})
        await robot.wait_error("has no podman for the image localhost/any:1")
