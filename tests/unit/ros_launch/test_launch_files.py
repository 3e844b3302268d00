"""Launch files: what is refused says file, line, element and reason; what roslaunch has not, and this has."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce.ros.launch import LaunchFileError, LaunchPlan, MachineInputs, load_launch_files
from rce.ros.launch.exceptions import LaunchValueError
from rce.ros.launch.expressions import evaluate
from rce.ros.launch.inputs import find_launch_file
from rce.ros.packages import PackageIndex


def load(folder: Path, text: str, *, ns: str = "/", **arguments: str) -> LaunchPlan:
    file = folder / "main.launch"
    file.write_text(f"<launch>\n{text}\n</launch>")
    inputs = MachineInputs(PackageIndex([folder]), {"HOME": str(folder)})
    return load_launch_files([file], arguments, inputs=inputs, namespace=ns)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('\n<param name="a"/>', "3: <param>: needs one of value, textfile, binfile, command, has none"),
        (
            '<param name="a" value="x" type="int"/>',
            "2: <param>: parameter a: value is 'x', must be an integer",
        ),
        ('<param name="a" value="3000000000"/>', "parameter a is 3000000000; integers have 32 bits"),
        ('<param name="a" value="$(arg b)"/>', "argument b is not set; give b:=VALUE"),
        ('<param name="a" value="$(env B)"/>', "there is no environment variable B"),
        ('<param name="a" value="$(find b)"/>', "no package 'b' on the package path"),
        ('<param name="a" value="$(fnid b)"/>', "$(fnid b) is not known; use one of anon, arg"),
        ('<param name="a" value="$(arg b"/>', "has a '$(' that is not closed"),
        ('<param name="a" value="x $(eval 1)"/>', "$(eval ...) must be the whole text"),
        ('<group if="perhaps"/>', "<group>: if is 'perhaps', must be true or false"),
        ('<node pkg="p" type="t" name="a/b"/>', "name is 'a/b', must be without a namespace; use ns"),
        (
            '<node pkg="p" type="t" name="a"/>\n<node pkg="q" type="t" name="a"/>',
            "two nodes are called /a, the",
        ),
        ('<node pkg="p" type="t" name="a" machine="m"/>', "machine is 'm': nodes start on this machine only"),
        ('<machine name="m" address="10.0.0.1"/>', "machine m is 10.0.0.1: nodes start on this machine only"),
        ('<node pkg="p" type="t" name="a" cwd="here"/>', "cwd is 'here', must be ROS_HOME or node"),
        (
            '<node pkg="p" type="t" name="a" respawn_delay="-1"/>',
            "respawn_delay is '-1', must be a number of",
        ),
        ('<node pkg="p" type="t" name="a">\n<param name="b"/></node>', "3: <param>: needs one of value"),
        ('<node pkg="p" type="t" name="a" args="&quot;x"/>', "args is '\"x': no closing quotation"),
        ('<include file="none.launch"/>', "<include>: none.launch: No such file or directory"),
        ('<include file="$(dirname)/main.launch"/>', "files include each other more than 32 deep"),
        ('<arg name="a" value="1"/>', "<arg>: argument a is fixed here and cannot be set; use default="),
        ("<rosparam>a: [1</rosparam>", "<rosparam>: is not valid YAML"),
        ("<rosparam>a: 2020-01-01</rosparam>", "parameter /a is a date; write text in quotes"),
        ("<rosparam>1: 2</rosparam>", "parameter /: the key 1 must be text"),
        ('<remap from="a" to="1b"/>', "<remap>: to is '1b', must be a name"),
        ("<a></b>", "not valid XML: mismatched tag"),
    ],
)
def test_an_error_names_place_and_reason(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(LaunchFileError) as caught:
        load(tmp_path, text, a="0")
    assert f"{tmp_path}/main.launch:" in str(caught.value) or "none.launch" in str(caught.value)
    assert reason in str(caught.value)


def test_an_error_names_the_files_that_include(tmp_path: Path) -> None:
    (tmp_path / "inner.launch").write_text('<launch>\n\n<param name="x" value="$(arg y)"/></launch>')
    with pytest.raises(LaunchFileError) as caught:
        load(tmp_path, '\n<include file="$(dirname)/inner.launch"/>')
    first, second = str(caught.value).splitlines()
    assert first.startswith(f"{tmp_path}/inner.launch:3: <param>: parameter x: argument y is not set")
    assert second == f"  included from {tmp_path}/main.launch:3"


@pytest.mark.parametrize(
    ("text", "warning"),
    [
        ("<nod/>", "2: <nod> is not an element of launch files"),
        ('<param nam="x" name="a" value="1"/>', "unknown attribute nam; did you mean name?"),
        ('<node pkg="p" type="t" name="my-node"/>', "'my-node' is not a legal name of a node"),
        ('<rosparam>{a: 1, b: 2}</rosparam><param name="a/c" value="1"/>', "parameter /a/c is below /a"),
        ("<test/>", "is left out: rostest runs tests"),
    ],
)
def test_a_doubtful_file_is_read_with_a_warning(tmp_path: Path, text: str, warning: str) -> None:
    plan = load(tmp_path, text)
    assert len(plan.warnings) == 1
    assert warning in plan.warnings[0]


def test_a_launch_has_a_namespace(tmp_path: Path) -> None:
    plan = load(tmp_path, '<node pkg="p" type="t" name="n"/><param name="a" value="1"/>', ns="Robot1")
    assert [node.name for node in plan.nodes] == ["/Robot1/n"]
    assert (plan.nodes[0].namespace, plan.parameters) == ("/Robot1", {"/Robot1/a": 1})


def test_this_machine_may_be_named(tmp_path: Path) -> None:
    text = '<machine name="here" address="localhost"/><node pkg="p" type="t" name="n" machine="here"/>'
    assert len(load(tmp_path, text).nodes) == 1


def test_an_anonymous_name_is_the_same_in_a_file(tmp_path: Path) -> None:
    plan = load(tmp_path, '<node pkg="p" type="t" name="$(anon n)" args="$(anon n) $(anon m)"/>')
    node = plan.nodes[0]
    assert node.name == f"/{node.arguments[0]}"
    assert node.arguments[0] != node.arguments[1]


def test_a_launch_file_is_found_in_its_package(tmp_path: Path) -> None:
    for name in ("launch/a.launch", "deep/er/b.launch", "one/c.launch", "two/c.launch"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert find_launch_file(tmp_path, "a.launch") == tmp_path / "launch" / "a.launch"
    assert find_launch_file(tmp_path, "b.launch") == tmp_path / "deep" / "er" / "b.launch"
    assert find_launch_file(tmp_path, "two/c.launch") == tmp_path / "two" / "c.launch"
    with pytest.raises(LaunchValueError, match="several files"):
        find_launch_file(tmp_path, "c.launch")
    with pytest.raises(LaunchValueError, match=r"has no file d\.launch"):
        find_launch_file(tmp_path, "d.launch")


@pytest.mark.parametrize(
    "text",
    [
        *("().__class__", "open('x')", "lambda: 1", "[x for x in y]", "2 ** 2 ** 20", "'a' * 9999"),
        *("x.format(y)", "f'{x}'", "(x := 1)", "x[", "a" * 5000, "1 / 0", "unknown", "str(x=1)"),
        *("'%1000000000d' % 1", "-" * 3000 + "1"),
    ],
)
def test_an_expression_reaches_nothing_else(text: str) -> None:
    with pytest.raises(LaunchValueError):
        evaluate(text, {"x": "1", "y": [1]}, {"str": str})
