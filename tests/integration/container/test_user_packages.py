"""Packages that users bring, in real containers."""

from __future__ import annotations

import dataclasses
import json
import os
import stat
import zipfile
from pathlib import Path

import pytest
from support.containers import Machine, until
from support.user_packages import pack, sign, write_package

from rce.aio.backoff import Backoff
from rce.control.model import NodeState, PackageSpec
from rce.model.specs import InterfaceSpec, NodeSpec, ParameterSpec
from rce_container.packages.requirements import Installer, InstallerSettings

BOX = "user/box"
SAY = "import sys, time\nprint(' '.join([{text!r}, *sys.argv[1:]]), flush=True)\ntime.sleep(600)\n"
LOOK = """
import json, os, sys, time
from pathlib import Path

def can(act):
    try:
        act()
    except OSError:
        return False
    return True

here = Path(__file__)
print(json.dumps({
    "file": str(here),
    "write": can(lambda: here.write_text("x")),
    "add": can(lambda: (here.parent / "new").write_text("x")),
    "chmod": can(lambda: here.chmod(0o777)),
    "bundles": sorted(os.listdir(here.parents[3])),
    "path": os.environ["RCE_PACKAGE_PATH"],
}), flush=True)
time.sleep(600)
"""


@pytest.fixture
def shop(machine: Machine) -> Machine:
    """A machine that is quick to try again."""
    machine.library = dataclasses.replace(machine.library, retry=Backoff(first=0.05, longest=0.05))
    return machine


def offer(
    machine: Machine, name: str, version: str = "1.0", *, hold: bool = False, **files: str
) -> PackageSpec:
    """Push a package to the machine's master."""
    archive = pack(write_package(machine.folder / "source" / version, name, **files))
    spec = sign(archive, name, version)
    if not hold:
        machine.contents[spec.sha256] = archive
    return spec


def node(pkg: str, exe: str = "run.py", tag: str = "node", args: str = "") -> NodeSpec:
    return NodeSpec(tag=tag, pkg=pkg, exe=exe, args=args)


async def test_a_node_of_a_brought_package_runs(shop: Machine) -> None:
    async with shop.engine():
        nav = offer(shop, "nav", nodes__run=LOOK)
        other = offer(shop, "other", nodes__run=SAY.format(text="hi"))
        await shop.put(BOX, nodes=(node("nav"),), packages=(nav,))
        await shop.put("eve/box", nodes=(node("own", "talk.py"),))
        seen = json.loads(await shop.log_holds(BOX, "node", "}"))
        assert Path(seen["file"]).parts[-4:] == (nav.sha256, "nav", "nodes", "run.py")
        assert seen["bundles"] == [nav.sha256]
        assert seen["path"].split(":")[0].endswith(nav.sha256)
        if shop.runtime.isolated:
            assert seen["file"].startswith("/opt/rce/bundles/")
            assert (seen["write"], seen["add"], seen["chmod"]) == (False, False, False)
        await shop.put(BOX, 2, nodes=(node("nav"), node("other", tag="more")), packages=(nav, other))
        await shop.log_holds(BOX, "more", "hi")
        held = [path for path in shop.containers if list((path / "bundles").iterdir())]
        assert len(held) == 1, "a container has packages that its user did not bring"
        assert not any(
            (path / "bundles.new").exists() and list((path / "bundles.new").iterdir()) for path in held
        )


async def test_a_users_package_comes_before_the_machines(shop: Machine) -> None:
    async with shop.engine():
        own = offer(shop, "own", nodes__talk=SAY.format(text="mine"))
        await shop.put(BOX, nodes=(node("own", "talk.py"),), packages=(own,))
        await shop.put("eve/box", nodes=(node("own", "talk.py"),))
        await shop.log_holds(BOX, "node", "mine")
        await shop.log_holds("eve/box", "node", "hello")


async def test_a_package_that_comes_late_holds_up_nothing_else(shop: Machine) -> None:
    async with shop.engine():
        nav = offer(shop, "nav", hold=True, nodes__run=SAY.format(text="here"), maps__a="")
        archive = pack(shop.folder / "source" / "1.0" / "nav")
        parameters = (ParameterSpec(name="/map", value="$(find nav)/maps"),)
        nodes = (node("nav", args="$(find nav)"), node("own", "talk.py", tag="talk"))
        await shop.put(BOX, nodes=nodes, packages=(nav,), parameters=parameters)
        await shop.log_holds(BOX, "talk", "hello")
        waiting = await shop.node_is(BOX, "node", NodeState.WAITING)
        assert waiting.detail == "waits for its package nav 1.0"
        await until(lambda: shop.faults, what="a fault")
        shop.contents[nav.sha256] = archive
        text = await shop.log_holds(BOX, "node", "here")
        assert text.strip().endswith("nav")
        assert len(shop.faults) == 1
        assert "package nav 1.0 is not there yet" in shop.faults[0]
        assert "rce package push" in shop.faults[0]


async def test_interfaces_wait_for_types_of_coming_package(shop: Machine) -> None:
    """Interfaces wait for types of a package that is still to come."""
    async with shop.engine():
        box = offer(shop, "Box", hold=True, nodes__run=SAY.format(text="here"))
        (shop.folder / "source" / "1.0" / "Box" / "srv").mkdir()
        (shop.folder / "source" / "1.0" / "Box" / "srv" / "Open.srv").write_text("---\nbool done\n")
        archive = pack(shop.folder / "source" / "1.0" / "Box")
        box = sign(archive, "Box", "1.0")
        interfaces = (
            InterfaceSpec(tag="open", type="ServiceClientInterface", message_type="Box/Open", addr="/open"),
            InterfaceSpec(tag="say", type="PublisherInterface", message_type="std_msgs/String", addr="/say"),
        )
        await shop.put(BOX, nodes=(node("Box"),), packages=(box,), interfaces=interfaces)
        await until(lambda: (status := shop.status(BOX)) and set(status.interfaces) == {"say"})
        shop.contents[box.sha256] = archive
        await until(lambda: (status := shop.status(BOX)) and set(status.interfaces) == {"say", "open"})
        await shop.log_holds(BOX, "node", "here")
        assert not [fault for fault in shop.faults if "interface" in fault]


async def test_a_new_version_comes_while_nodes_run(shop: Machine) -> None:
    async with shop.engine():
        old = offer(shop, "nav", "1.0", nodes__run=SAY.format(text="old"))
        new = offer(shop, "nav", "1.10", nodes__run=SAY.format(text="new"))
        await shop.put(BOX, nodes=(node("nav"),), packages=(old,))
        await shop.log_holds(BOX, "node", "old")
        before = await shop.node_pid(BOX, "node")
        nodes = (node("nav"), node("nav", tag="newer"), node("nav@1.0", tag="fixed"))
        await shop.put(BOX, 2, nodes=nodes, packages=(old, new))
        await shop.log_holds(BOX, "newer", "new")
        await shop.log_holds(BOX, "fixed", "old")
        assert shop.reported_node(BOX, "node").pid == before


async def test_a_new_manager_goes_on_where_the_old_one_was(shop: Machine) -> None:
    async with shop.managed():
        nav = offer(shop, "nav", nodes__run=SAY.format(text="here"))
        late = offer(shop, "late", hold=True, nodes__run=SAY.format(text="late"))
        nodes = (node("nav"), node("late", tag="late"))
        await shop.put(BOX, nodes=nodes, packages=(nav, late))
        await shop.log_holds(BOX, "node", "here")
        before = await shop.node_pid(BOX, "node")
        await shop.node_is(BOX, "late", NodeState.WAITING)
    (shop.folder / "bundles" / "incoming" / "half").mkdir(parents=True)
    shop.library.open()
    async with shop.engine():
        shop.contents[late.sha256] = pack(shop.folder / "source" / "1.0" / "late")
        await shop.put(BOX, nodes=nodes, packages=(nav, late))
        await shop.log_holds(BOX, "late", "late")
        assert shop.reported_node(BOX, "node").pid == before
        assert not (shop.folder / "bundles" / "incoming" / "half").exists()


async def test_what_was_not_signed_is_not_unpacked(shop: Machine) -> None:
    async with shop.engine():
        nav = offer(shop, "nav", nodes__run=SAY.format(text="here"))
        other = pack(write_package(shop.folder / "evil", "nav", nodes__run=SAY.format(text="evil")))
        forged = sign(other, "nav", "1.0", user="eve")
        shop.contents[nav.sha256] = other
        shop.contents[forged.sha256] = other
        await shop.put(BOX, nodes=(node("nav"),), packages=(nav,))
        await shop.put("user/box2", nodes=(node("nav"),), packages=(forged,))
        await until(lambda: len(shop.faults) == 2, what=lambda: shop.faults)
        assert any("not what was signed" in fault for fault in shop.faults)
        assert any("does not fit the key" in fault for fault in shop.faults)
        kept = [path.name for path in (shop.folder / "bundles").iterdir()]
        assert sorted(kept) in (["boot"], ["boot", "incoming"])


def write_wheel(folder: Path, name: str, text: str) -> None:
    folder.mkdir(exist_ok=True)
    info = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(folder / f"{name}-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr(f"{name}.py", text)
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")


USE = "import sys, time\nimport gripper_math\nprint(gripper_math.ANSWER, flush=True)\ntime.sleep(600)\n"


@pytest.mark.needs("bwrap")
async def test_requirements_are_installed_where_it_is_allowed(shop: Machine) -> None:
    write_wheel(shop.folder / "wheels", "gripper_math", "ANSWER = 'forty-two'\n")
    arguments = ("--no-index", f"--find-links={shop.folder / 'wheels'}")
    installer = Installer(shop.folder / "requirements", InstallerSettings(pip_args=arguments), {})
    shop.library = dataclasses.replace(shop.library, installer=installer)
    shop.library.open()
    async with shop.engine():
        hand = offer(shop, "hand", nodes__run=USE, requirements="gripper_math ~= 1.0  # for the fingers\n")
        bad = offer(shop, "bad", nodes__run=USE, requirements="nowhere_to_be_found\n")
        path = offer(shop, "path", nodes__run=USE, requirements="-e /etc\n")
        theirs = (node("hand"), node("bad", tag="bad"), node("path", tag="path"))
        nodes = (*theirs, NodeSpec(tag="own", pkg="own", exe="end.py"))
        await shop.put(BOX, nodes=nodes, packages=(hand, bad, path))
        await shop.log_holds(BOX, "node", "forty-two")
        await until(lambda: len(shop.faults) >= 2, what=lambda: shop.faults)
        assert any("pip could not install" in text and "nowhere" in text for text in shop.faults)
        assert any("line 1" in text and "-e /etc" in text for text in shop.faults)
        (site,) = [path for path in (shop.folder / "requirements").iterdir() if len(path.name) == 64]
        module = site / "gripper_math.py"
        assert stat.S_IMODE(module.stat().st_mode) == 0o444
        assert module.stat().st_uid == os.geteuid()


async def test_requirements_are_left_out_where_it_is_not_allowed(shop: Machine) -> None:
    async with shop.engine():
        hand = offer(shop, "hand", nodes__run=SAY.format(text="without"), requirements="six\n")
        await shop.put(BOX, nodes=(node("hand"),), packages=(hand,))
        await shop.log_holds(BOX, "node", "without")
        await until(lambda: shop.faults, what="a warning")
        assert "--allow-requirements" in shop.faults[0]
