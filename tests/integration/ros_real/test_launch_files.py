"""Our reader of launch files against ROS's own roslaunch: the same parameters and nodes."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import launch_reference
from support.ros_real import ros_environment

from rce.ros.launch import LaunchFileError, LaunchPlan, MachineInputs, load_launch_files
from rce.ros.packages import PackageIndex

pytestmark = pytest.mark.needs("roslaunch")

VARIABLES = {"TEST_WORD": "from_env", "TEST_NUMBER": "12"}


class Comparison:
    """A running roslaunch, and the folder of the files to compare."""

    def __init__(self, process: subprocess.Popen[str], folder: Path, environ: dict[str, str]) -> None:
        self.folder = folder
        self._process = process
        self._inputs = MachineInputs(PackageIndex(environ["ROS_PACKAGE_PATH"].split(":")), environ)

    def theirs(self, file: Path, arguments: list[str]) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([str(file), arguments]) + "\n")
        self._process.stdin.flush()
        found: dict[str, Any] = json.loads(self._process.stdout.readline())
        return found

    def ours(self, file: Path, arguments: list[str]) -> dict[str, Any]:
        pairs = dict(argument.split(":=") for argument in arguments)
        try:
            return as_theirs(load_launch_files([file], pairs, inputs=self._inputs))
        except LaunchFileError as error:
            return {"error": str(error)}

    def check(self, text: str, *arguments: str, **included: str) -> dict[str, Any]:
        """Compare both readings of a file; return ours."""
        file = self.folder / "main.launch"
        file.write_text(f"<launch>{text}</launch>")
        for name, inner in included.items():
            (self.folder / f"{name}.launch").write_text(f"<launch>{inner}</launch>")
        theirs, ours = self.theirs(file, list(arguments)), self.ours(file, list(arguments))
        if "error" in theirs or "error" in ours:
            assert ("error" in theirs) == ("error" in ours), (theirs, ours, text)
        else:
            assert ours == theirs, text
        return ours


def as_theirs(plan: LaunchPlan) -> dict[str, Any]:
    return {
        "parameters": plan.parameters,
        "nodes": [
            {
                "name": node.name,
                "package": node.package,
                "type": node.type,
                "arguments": list(node.arguments),
                "remappings": [list(pair) for pair in node.remappings],
                "environ": [list(pair) for pair in node.environ],
                "prefix": list(node.prefix),
                "output": node.output.value,
                "folder": node.folder.value,
                "respawn": node.respawn,
                "respawn_delay": node.respawn_delay,
                "required": node.required,
            }
            for node in plan.nodes
        ],
        "cleared": plan.cleared,
    }


@pytest.fixture(scope="module")
def roslaunch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Comparison]:
    folder = tmp_path_factory.mktemp("launch")
    environ = {**ros_environment("http://127.0.0.1:1/", folder), **VARIABLES}
    command = ["/usr/bin/python3", launch_reference.__file__]
    with subprocess.Popen(
        command, env=environ, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Comparison(process, folder, environ)
        assert process.stdin is not None
        process.stdin.close()


FILES = {
    "types": """
        <param name="a" value="1"/><param name="b" value=" 2.5 "/><param name="c" value="TRUE"/>
        <param name="d" value="1_0"/><param name="e" value="1e3"/><param name="f" value="1.e3"/>
        <param name="g" value="007" type="str"/><param name="h" value="7" type="double"/>
        <param name="i" value="1" type="bool"/><param name="j" value="[1, {k: 2}]" type="yaml"/>
        <param name="k" value=""/><param name="l" value="-3"/><param name="m" value="nan.5"/>""",
    "namespaces": """
        <param name="/top" value="1"/><param name="a//b/" value="2"/>
        <group ns="g"><param name="x" value="3"/><param name="/abs" value="4"/>
          <group ns="/other/"><param name="x" value="5"/></group>
          <node pkg="p" type="t" name="n" ns="m"><param name="q" value="6"/><param name="~r" value="7"/>
          <rosparam param="s">[1, 2]</rosparam><param name="/t" value="8"/></node></group>""",
    "private": """
        <param name="~all" value="1"/><node pkg="p" type="t" name="a"/>
        <group><param name="~some" value="2"/><param name="~all" value="3"/>
          <node pkg="p" type="t" name="b"/></group>
        <node pkg="p" type="t" name="c"><param name="all" value="4"/><rosparam>all: 5</rosparam></node>""",
    "remappings": """
        <remap from="a" to="b"/><node pkg="p" type="t" name="one"/><remap from="a" to="c"/>
        <group><remap from="d//e/" to="/f"/>
          <node pkg="p" type="t" name="two"><remap from="a" to="z"/></node></group>
        <node pkg="p" type="t" name="three"/>""",
    "environment": """
        <env name="A" value="1"/>
        <node pkg="p" type="t" name="one"><env name="B" value="$(env TEST_WORD)"/></node>
        <group><env name="A" value="2"/><node pkg="p" type="t" name="two"/></group>
        <node pkg="p" type="t" name="three"/>""",
    "conditions": """
        <arg name="yes" default="true"/><arg name="no" default="0"/>
        <param name="a" value="1" if="$(arg yes)"/><param name="b" value="1" unless="$(arg yes)"/>
        <param name="c" value="1" if="$(arg no)"/>
        <group unless="$(arg no)"><param name="d" value="1"/></group>
        <node pkg="p" type="t" name="n" if="1"><param name="e" value="1" if="false"/>
        <remap from="x" to="y" unless="true"/></node>""",
    "node": """
        <node pkg="p" type="t" name="n" args="-a 'b c' $(optenv NO_SUCH some words)"
          output="screen" cwd="node"
          respawn="true" respawn_delay="2.5" launch-prefix="nice -n 5"/>
        <node pkg="p" type="t" name="m" required="True" cwd="ros_home" clear_params="true"/>
        <group ns="a" clear_params="true"/>""",
    "evaluation": """
        <arg name="x" default="3"/><arg name="name" default="kobuki"/><arg name="ok" default="true"/>
        <param name="a" value="$(eval 2 * x + 1)"/><param name="b" value="$(eval name == 'kobuki' and ok)"/>
        <param name="c" value="$(eval 'a' if arg('x') > 2 else 'b')"/>
        <param name="d" value="$(eval sqrt(x) * pi)"/>
        <param name="e" value="$(eval '%s_%d' % (name, x))"/><param name="f" value="$(eval [x, 1.5][0])"/>
        <param name="g" value="$(eval env('TEST_NUMBER'))"/><param name="h" value="$(eval not ok)"/>
        <param name="i" value="$(eval name.upper()[1:3])"/><param name="j" value="$(eval (1, 'x'))"/>
        <param name="k" value="$(eval 1 &lt; x &lt; 5)"/><param name="l" value="$(eval int(x / 2))"/>""",
    "yaml": """
        <arg name="r" default="Robot1"/><rosparam>
        a: {b: 1, c: [1, 2.5, text]}
        /global: true
        d: deg(180)
        e: rad(pi/2)
        f: !degrees 90
        </rosparam><rosparam ns="n" param="x" subst_value="true">[$(arg r), 2]</rosparam>
        <rosparam param="empty"/>
        <group ns="g"><rosparam subst_value="True">{frame: $(arg r)/odom}</rosparam></group>""",
    "text": """<param name="a" textfile="$(dirname)/words.txt"/><param name="b" command="echo 5"/>
        <param name="c" command="echo '1.5'" type="double"/><param name="d" command="printf x y"/>""",
    "dollars": """<param name="a" value="$ $$ $x ) ( $$(env TEST_WORD)$()" type="str"/>""",
    "packages": """<param name="a" value="$(find std_msgs)/msg $(find rosgraph_msgs)"/>""",
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_read_as_roslaunch_reads_it(roslaunch: Comparison, name: str) -> None:
    (roslaunch.folder / "words.txt").write_text(" some words\n")
    assert "error" not in roslaunch.check(FILES[name])


@pytest.mark.parametrize(
    "text",
    [
        '<param name="a"/>',
        '<param name="a" value="1" textfile="x"/>',
        '<param value="1"/>',
        '<param name="a" value="x" type="int"/>',
        '<param name="a" value="x" type="tuple"/>',
        '<param name="a" value="$(arg no)"/>',
        '<param name="a" value="$(env NO_SUCH)"/>',
        '<param name="a" value="$(find no_such_package)"/>',
        '<param name="a" value="$(nothing x)"/>',
        '<param name="a" value="$(env A $(env B))"/>',
        '<param name="a" value="$(eval __import__)"/>',
        '<param name="a" value="1" if="maybe"/>',
        '<param name="a" value="1" if="1" unless="1"/>',
        '<arg name="a" value="1" default="2"/>',
        '<arg name="a" value="1"/><arg name="a" value="2"/>',
        '<node pkg="p" type="t"/>',
        '<node pkg="p" name="n"/>',
        '<node pkg="p" type="t" name="a/b"/>',
        '<node pkg="p" type="t" name="a"/><node pkg="p" type="t" name="a"/>',
        '<node pkg="p" type="t" name="a" output="both"/>',
        '<node pkg="p" type="t" name="a" respawn="true" required="true"/>',
        '<node pkg="p" type="t" name="a" respawn="1"/>',
        '<node pkg="p" type="t" name="a" ns=""/>',
        '<group clear_params="true"/>',
        '<include file="$(dirname)/missing.launch"/>',
        '<remap from="a"/>',
        '<remap from="-a" to="b"/>',
        "<rosparam>a: [</rosparam>",
        "<rosparam>[1]</rosparam>",
        '<rosparam command="load" file="missing.yaml"/>',
        '<rosparam command="hide" param="x"/>',
        "<unclosed>",
    ],
)
def test_both_refuse_a_wrong_file(roslaunch: Comparison, text: str) -> None:
    assert "error" in roslaunch.check(text)


def test_arguments_come_from_the_command_line(roslaunch: Comparison) -> None:
    text = '<arg name="x" default="1"/><arg name="y"/><param name="x" value="$(arg x)"/>'
    assert roslaunch.check(text, "x:=2", "y:=3", "extra:=4")["parameters"] == {"/x": 2}
    assert "error" in roslaunch.check('<arg name="x" value="1"/>', "x:=2")


INCLUDED = """<arg name="a" default="inner"/><arg name="b"/><param name="a" value="$(arg a)"/>
    <param name="b" value="$(arg b)"/><node pkg="p" type="t" name="n" args="$(dirname)"/>"""


@pytest.mark.parametrize(
    ("attributes", "inner", "is_read"),
    [
        ('ns="one"', '<arg name="b" value="2"/>', True),
        ("", '<arg name="b" default="$(arg a)"/><env name="E" value="1"/>', True),
        ("", "", False),
        ("", '<arg name="b" value="1"/><arg name="c" value="2"/>', False),
        ('pass_all_args="true"', '<arg name="b" value="$(arg a)"/>', True),
        (
            'pass_all_args="true" ns="x" clear_params="true"',
            '<arg name="a" value="5"/><arg name="b" value="6"/>',
            True,
        ),
        ('if="false"', "", True),
    ],
)
def test_an_included_file_gets_its_arguments(
    roslaunch: Comparison, attributes: str, inner: str, is_read: bool
) -> None:
    text = f"""<arg name="a" default="outer"/><remap from="r" to="s"/><param name="~p" value="1"/>
        <include file="$(dirname)/inner.launch" {attributes}>{inner}</include>"""
    found = roslaunch.check(text, inner=INCLUDED)
    assert ("error" not in found) is is_read


# Any files

NAMES = st.sampled_from(["a", "b", "c", "ns/a", "/g/a"])
ARGUMENTS = ("x", "y", "z")
VALUES = st.one_of(
    st.integers(-50, 50).map(str),
    st.floats(-9, 9).map(lambda value: str(round(value, 3))),
    st.sampled_from(["true", "False", "text", "two words", "1_000", "1e5", ".5", "", "a.b", " 7 "]),
    st.sampled_from([f"$(arg {name})" for name in ARGUMENTS]),
    st.sampled_from(["pre_$(arg x)/$(arg y)", "$(env TEST_WORD)", "$(optenv NO_SUCH 3)", "$(eval x)"]),
    st.sampled_from(["$(eval arg('x') == y)", "$(eval str(x) + '_' + str(y))", "$(eval z or 2)"]),
)
CONDITIONS = st.sampled_from(
    ["", "", "", ' if="true"', ' unless="1"', ' if="$(arg z)"', " unless=\"$(eval x == 'text')\""]
)


def attribute(name: str, value: str) -> str:
    return f" {name}={quoteattr(value)}"


def element(
    tag: str, attributes: st.SearchStrategy[str], inner: st.SearchStrategy[str] | None = None
) -> st.SearchStrategy[str]:
    return st.tuples(attributes, CONDITIONS, st.just("") if inner is None else inner).map(
        lambda parts: f"<{tag}{parts[0]}{parts[1]}>{parts[2]}</{tag}>"
    )


PRIVATE_NAMES = st.sampled_from(["a", "b", "~a", "~c", "ns/b"])
NAMESPACES = st.sampled_from(["", ' ns="g"', ' ns="g/h"', ' ns="/top"', ' ns="$(arg y)"'])
param = element(
    "param", st.builds(lambda name, value: attribute("name", name) + attribute("value", value), NAMES, VALUES)
)
private = element(
    "param",
    st.builds(lambda name, value: attribute("name", name) + attribute("value", value), PRIVATE_NAMES, VALUES),
)
rosparam = element(
    "rosparam",
    st.sampled_from(["", ' param="p"', ' ns="n"', ' subst_value="true"', ' ns="n" param="/p"']),
    st.sampled_from(["{a: 1, b: {c: [1, x]}}", "a: $(arg x)", "[1, 2]", "", "{/abs: true, d: 1.5}"]),
)
remap = element(
    "remap",
    st.builds(lambda one, two: attribute("from", one) + attribute("to", two), NAMES, NAMES),
)
env = element(
    "env",
    st.builds(
        lambda name, value: attribute("name", name) + attribute("value", value), st.sampled_from("AB"), VALUES
    ),
)
arg = element(
    "arg",
    st.builds(
        lambda name, key, value: attribute("name", name) + attribute(key, value),
        st.sampled_from(["q", "r", "s", "t", "u", "v", "x"]),
        st.sampled_from(["default", "default", "value"]),
        VALUES,
    ),
)
node = element(
    "node",
    st.builds(
        lambda name, space, args, rest: (
            f' pkg="p" type="t"{attribute("name", name)}{space}{attribute("args", args)}{rest}'
        ),
        st.sampled_from(["n1", "n2", "n3", "n4", "n5", "$(arg y)"]),
        NAMESPACES,
        VALUES,
        st.sampled_from(
            ["", ' respawn="true"', ' output="screen"', ' clear_params="true"', ' required="$(arg z)"']
        ),
    ),
    st.lists(st.one_of(private, rosparam, remap, env), max_size=3).map("".join),
)
leaf = st.one_of(param, rosparam, remap, env, arg, node)
body = st.recursive(
    st.lists(leaf, max_size=4).map("".join),
    lambda inner: st.lists(st.one_of(leaf, private, element("group", NAMESPACES, inner)), max_size=5).map(
        "".join
    ),
    max_leaves=8,
)
include = element(
    "include",
    st.builds(
        lambda space, passes: f' file="$(dirname)/inner.launch"{space}{passes}',
        NAMESPACES,
        st.sampled_from(["", ' pass_all_args="true"']),
    ),
    st.lists(st.one_of(arg, env), max_size=2).map("".join),
)
DECLARED = '<arg name="x" default="1"/><arg name="y" default="word"/><arg name="z" default="false"/>'


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(
    before=body,
    included=st.one_of(st.just(""), include),
    after=body,
    inner=st.one_of(st.just(INCLUDED), body.map(lambda text: DECLARED + text)),
    given_x=st.sampled_from([[], ["x:=text"], ["x:=3", "z:=true"]]),
)
def test_any_file_is_read_as_roslaunch_reads_it(
    roslaunch: Comparison, before: str, included: str, after: str, inner: str, given_x: list[str]
) -> None:
    roslaunch.check(DECLARED + before + included + after, *given_x, inner=inner)


def test_an_angle_is_exact(roslaunch: Comparison) -> None:
    found = roslaunch.check('<rosparam param="a">[deg(180), rad(pi/4)]</rosparam>')
    assert found["parameters"]["/a"] == [math.pi, math.pi / 4]
