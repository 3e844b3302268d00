"""Checksums and definition texts are those of ROS; rosbags and Debian's own ROS are the oracles."""

import json
import re
import subprocess
from functools import cache
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore

from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.ros.types.registry import builtin_definitions

MESSAGES = sorted(name for kind, name in builtin_definitions() if kind == "msg")
SERVICES = sorted(name for kind, name in builtin_definitions() if kind == "srv")
SYSTEM_PYTHON = "/usr/bin/python3"
SYSTEM_PACKAGES = (
    "std_msgs",
    "geometry_msgs",
    "sensor_msgs",
    "nav_msgs",
    "std_srvs",
    "rosgraph_msgs",
    "roscpp",
)

DEBIANS_PACKAGES = {
    "actionlib",
    "actionlib_msgs",
    "diagnostic_msgs",
    "geometry_msgs",
    "map_msgs",
    "move_base_msgs",
    "nav_msgs",
    "pcl_msgs",
    "roscpp",
    "rosgraph_msgs",
    "sensor_msgs",
    "shape_msgs",
    "std_msgs",
    "std_srvs",
    "stereo_msgs",
    "tf2_msgs",
    "topic_tools",
    "trajectory_msgs",
    "visualization_msgs",
}


@pytest.mark.parametrize(
    ("name", "md5sum"),
    [
        ("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("std_msgs/Empty", "d41d8cd98f00b204e9800998ecf8427e"),
        ("std_msgs/Header", "2176decaecbce78abc3b96ef049fabed"),
        ("geometry_msgs/PoseWithCovarianceStamped", "953b798c0f514ff060a53a3498ce6246"),
        ("nav_msgs/OccupancyGrid", "3381f2d731d4076ec5c71b0759edbe4e"),
        ("sensor_msgs/Image", "060021388200f6f0f447d0fcd9c64743"),
        ("rosgraph_msgs/Log", "acffd30cd6b6de30f120938c17c593fb"),
        ("tf2_msgs/TFMessage", "94810edda583a504dfda3829e70d7eec"),
        ("actionlib_msgs/GoalStatusArray", "8b2b82f13216d0a8ea88bd3af735e619"),
        ("move_base_msgs/MoveBaseAction", "70b6aca7c7f7746d8d1609ad94c80bb8"),
        ("tf2_msgs/LookupTransformAction", "7ee01ba91a56c2245c610992dbaa3c37"),
    ],
)
def test_known_checksums_of_messages(name: str, md5sum: str) -> None:
    assert TypeRegistry().message(name).md5sum == md5sum


@pytest.mark.parametrize(
    ("name", "md5sum"),
    [
        ("std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e"),
        ("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522"),
        ("rospy_tutorials/AddTwoInts", "6a2e34150c00229791cc89ff309fff21"),
        ("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0"),
        ("dynamic_reconfigure/Reconfigure", "bb125d226a21982a4a98760418dc2672"),
    ],
)
def test_known_checksums_of_services(name: str, md5sum: str) -> None:
    assert TypeRegistry().service(name).md5sum == md5sum


def test_every_builtin_message_has_the_checksum_that_rosbags_has() -> None:
    store, types = get_typestore(Stores.ROS1_NOETIC), TypeRegistry()
    compared = 0
    for name in MESSAGES:
        full = name.replace("/", "/msg/")
        if full in store.fielddefs:
            assert types.message(name).md5sum == store.generate_msgdef(full)[1], name
            compared += 1
    assert compared > 130


def test_every_builtin_service_can_be_made() -> None:
    types = TypeRegistry()
    for name in SERVICES:
        service = types.service(name)
        assert service.request.serialize({}) is not None
        assert service.response.name == f"{name}Response"


def test_a_type_learned_from_its_full_text_is_the_same() -> None:
    types = TypeRegistry()
    for name in MESSAGES:
        original = types.message(name)
        learned = TypeRegistry(PackageIndex([])).from_definition(name, original.definition)
        assert (learned.md5sum, learned.definition) == (original.md5sum, original.definition)


def test_learned_type_does_not_replace_another() -> None:
    """A learned type is remembered but does not replace another."""
    types = TypeRegistry()
    learned = types.from_definition("mine/Thing", "int8 x\n")
    assert types.message("mine/Thing") is learned
    assert types.from_definition("mine/Thing", "int8 x # again\n") is learned
    other = types.from_definition("std_msgs/String", "int8 x\n")
    assert types.message("std_msgs/String") is not other


def test_the_full_text_lists_each_needed_type_once_depth_first() -> None:
    text = TypeRegistry().message("geometry_msgs/PoseWithCovarianceStamped").definition
    parts = [line for line in text.splitlines() if line.startswith("MSG: ")]
    assert parts == [
        "MSG: std_msgs/Header",
        "MSG: geometry_msgs/PoseWithCovariance",
        "MSG: geometry_msgs/Pose",
        "MSG: geometry_msgs/Point",
        "MSG: geometry_msgs/Quaternion",
    ]
    assert text.count("=" * 80 + "\n") == 5


SYSTEM_CLASSES = """
import importlib, json, pathlib, sys
found = {"msg": {}, "srv": {}}
for kind in found:
    for folder in pathlib.Path("/usr/lib/python3/dist-packages").glob(f"*/{kind}/__init__.py"):
        try:
            module = importlib.import_module(f"{folder.parts[-3]}.{kind}")
        except ImportError:
            continue
        for c in vars(module).values():
            if hasattr(c, "_md5sum") and not (kind == "srv" and not hasattr(c, "_request_class")):
                found[kind][c._type] = [c._md5sum, getattr(c, "_full_text", "")]
print(json.dumps(found))
"""


@cache
def _system_ros() -> dict[str, dict[str, list[str]]]:
    """Return md5sum and full text of all of Debian's generated classes; empty where ROS is not installed."""
    try:
        done = subprocess.run(
            [SYSTEM_PYTHON, "-c", SYSTEM_CLASSES], capture_output=True, text=True, check=True, timeout=50
        )
    except (OSError, subprocess.SubprocessError):
        return {}
    found: dict[str, dict[str, list[str]]] = json.loads(done.stdout)
    return found


GENERATED = "# ====== DO NOT MODIFY! AUTOGENERATED FROM AN ACTION DEFINITION ======"


def _same(mine: str, theirs: str) -> bool:
    """Compare full texts; genpy may leave out the last line end, and marks what it made of an action."""
    if GENERATED not in theirs:
        return mine.rstrip("\n") == theirs.rstrip("\n")
    lines = [[line for line in text.splitlines() if line and line != GENERATED] for text in (mine, theirs)]
    return lines[0] == lines[1]


@pytest.mark.needs("rospy")
def test_checksum_equals_installed_ros_messages() -> None:
    """Checksum and full text are those of all installed ros messages."""
    classes = _system_ros()["msg"]
    assert {"std_msgs/String", "sensor_msgs/Image", "roscpp/Logger", "rosgraph_msgs/Log"} <= classes.keys()
    types = TypeRegistry(PackageIndex(["/usr/share"]))
    for name, (md5sum, full_text) in classes.items():
        assert types.message(name).md5sum == md5sum, name
        if Path("/usr/share", name.replace("/", "/msg/") + ".msg").exists():
            # Else the type is one that is built in, whose text has no comments.
            assert _same(types.message(name).definition, full_text), name


@pytest.mark.needs("rospy")
def test_checksums_are_those_of_all_installed_ros_services() -> None:
    classes = _system_ros()["srv"]
    assert {"roscpp/GetLoggers", "std_srvs/Trigger"} <= classes.keys()
    types = TypeRegistry(PackageIndex(["/usr/share"]))
    for name, (md5sum, _) in classes.items():
        assert types.service(name).md5sum == md5sum, name


MD5_OF_HEADER = re.compile(r"struct MD5Sum<.*?return \"([0-9a-f]{32})\"", re.DOTALL)
"""What gencpp wrote; in a service's header, the first is the service's own."""


@pytest.mark.needs("rospy")
def test_installed_definitions_have_ros_checksums() -> None:
    """Each ``.msg`` and ``.srv`` in ``/usr/share`` is compared with genpy's class and gencpp's header."""
    types, classes = TypeRegistry(PackageIndex(["/usr/share"])), _system_ros()
    compared: set[str] = set()
    alone: set[str] = set()
    for kind, of in (("msg", types.message), ("srv", types.service)):
        for file in Path("/usr/share").glob(f"*/{kind}/*.{kind}"):
            name = f"{file.parts[-3]}/{file.stem}"
            md5sum, found = of(name).md5sum, []
            if name in classes[kind]:
                found.append(classes[kind][name][0])
            for include in ("/usr/include", *map(str, Path("/usr/include").glob("*-linux-gnu"))):
                header = Path(include, f"{name}.h")
                if header.exists() and (written := MD5_OF_HEADER.search(header.read_text())):
                    found.append(written[1])
            assert set(found) <= {md5sum}, name
            (compared if found else alone).add(name)
    assert {"std_msgs/String", "sensor_msgs/Image", "roscpp/GetLoggers"} <= compared
    assert not alone, "installed without the classes that ROS makes of them"


@pytest.mark.needs("ros_msgs")
def test_all_message_packages_of_debian_are_compared() -> None:
    names = {*_system_ros()["msg"], *_system_ros()["srv"]}
    assert {name.partition("/")[0] for name in names} >= DEBIANS_PACKAGES


def test_builtin_definitions_are_those_of_installed_packages() -> None:
    folders = [Path("/usr/share") / package for package in SYSTEM_PACKAGES]
    if not all(folder.is_dir() for folder in folders):
        pytest.skip(f"not all of {', '.join(SYSTEM_PACKAGES)} are installed in /usr/share")
    installed, builtin = TypeRegistry(PackageIndex(["/usr/share"])), TypeRegistry(PackageIndex([]))
    for folder in folders:
        for file in folder.glob("msg/*.msg"):
            name = f"{folder.name}/{file.stem}"
            assert builtin.message(name).md5sum == installed.message(name).md5sum, name
        for file in folder.glob("srv/*.srv"):
            name = f"{folder.name}/{file.stem}"
            assert builtin.service(name).md5sum == installed.service(name).md5sum, name
