"""Reading definition texts, and what is refused."""

from pathlib import Path

import pytest

from rce.ros.packages import PackageIndex
from rce.ros.types import BadDefinitionError, TypeRegistry, UnknownTypeError
from rce.ros.types.definition import parse_message, parse_service, split_full_text


def test_fields_know_their_type_and_array() -> None:
    fields = parse_message(
        "my_pkg/All",
        "Header header\nPoint[3] corners\nother/Thing[] things # why\n\n  uint8[16]\tid\nstring s\n",
    ).fields
    assert [(field.name, field.type, field.is_array, field.length) for field in fields] == [
        ("header", "std_msgs/Header", False, None),
        ("corners", "my_pkg/Point", True, 3),
        ("things", "other/Thing", True, None),
        ("id", "uint8", True, 16),
        ("s", "string", False, None),
    ]


@pytest.mark.parametrize("separator", ["\x0b", "\x0c", "\x1c", "\x85", "\u2028", "\u2029"])
def test_only_line_ends_of_files_end_a_comment(separator: str) -> None:
    """Text from web pages and old editors has others; ROS's genmsg reads them as part of the line."""
    text = f"# the{separator} robot place\r\nint32 x\r\n"
    assert [field.name for field in parse_message("p/T", text).fields] == ["x"]
    request, response = parse_service("p/S", f"{text}---\n{text}")
    assert [[field.name for field in part.fields] for part in (request, response)] == [["x"], ["x"]]


def test_constants_have_values_of_their_type() -> None:
    constants = parse_message(
        "p/C",
        "int8 A=-1\nuint32 B = 0x10 # hex\nfloat32 C=1e3\nbool D=True\n"
        "string E= has # and = inside  \nint32 F=010",
    ).constants
    assert {constant.name: constant.value for constant in constants} == {
        "A": -1,
        "B": 16,
        "C": 1000.0,
        "D": True,
        "E": "has # and = inside",
        "F": 10,
    }


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("string", "'string' is neither"),
        ("string a b", "is neither"),
        ("str!ng a", "is not a type"),
        ("a/b/c d", "is not a type"),
        ("uint8 9a", "is not a field name"),
        ("uint8[-1] a", "is not a type"),
        ("uint8[99999999] a", "longer than"),
        ("uint8 A=300", "out of the range of uint8"),
        ("uint8 A=x", "invalid literal"),
        ("bool A=maybe", "is not a bool"),
        ("time A=1", "cannot be of type time"),
        ("p/Other A=1", "cannot be of type p/Other"),
        ("uint8 first", "'first' is declared twice"),
    ],
)
def test_a_fault_is_told_with_file_and_line(line: str, part: str) -> None:
    with pytest.raises(BadDefinitionError) as caught:
        parse_message("p/T", f"# a comment\nuint8 first\n{line}\n", "/some/T.msg")
    assert caught.value.line == 3
    assert str(caught.value).startswith("/some/T.msg:3: ")
    assert part in str(caught.value)


def test_service_errors_name_lines_of_the_file() -> None:
    """A service is a request and a response with lines of the file."""
    request, response = parse_service("p/S", "int64 a\n  ---  \nint64 sum\n")
    assert [field.name for field in request.fields] == ["a"]
    assert [(field.name, field.line) for field in response.fields] == [("sum", 3)]
    with pytest.raises(BadDefinitionError) as caught:
        parse_service("p/S", "int64 a\n---\nbad\n", "S.srv")
    assert caught.value.line == 3


@pytest.mark.parametrize("text", ["int64 a\n", "---\n---\n"])
def test_a_service_has_exactly_one_separator(text: str) -> None:
    with pytest.raises(BadDefinitionError, match="one '---' line"):
        parse_service("p/S", text)


def test_a_full_text_is_split_and_a_wrong_part_refused() -> None:
    separator = "=" * 80
    parts = dict(split_full_text("a/A", f"b/B b\n\n{separator}\nMSG: b/B\nint8 x\n"))
    assert parts == {"a/A": "b/B b\n", "b/B": "int8 x\n"}
    with pytest.raises(BadDefinitionError, match="not with 'MSG: '"):
        list(split_full_text("a/A", f"int8 x\n{separator}\nb/B\n"))


def test_a_type_that_holds_itself_is_refused() -> None:
    separator = "=" * 80
    with pytest.raises(BadDefinitionError, match="a/A > a/B > a/A"):
        TypeRegistry().from_definition("a/A", f"B b\n{separator}\nMSG: a/B\nA[] a\n")


@pytest.mark.parametrize(
    ("outer", "inner", "part"),
    [
        ("B[1000] b", "C[1000] c\nfloat64 x", "1001002000 elements in all"),
        ("uint8 x\nB[4] b", "C[5] c", "24 messages without content"),
        ("B[600] b", "C[600] c", "messages without content"),
        ("B b", "float64[1048576] x\nfloat64[1048576] y", "2097153 elements in all"),
    ],
)
def test_fixed_arrays_are_bounded_together(outer: str, inner: str, part: str) -> None:
    """What they multiply to takes memory and time that no length of a message bounds."""
    separator = "=" * 80
    innermost = "float64[1000] x" if "x" in inner else "# nothing"
    text = f"{outer}\n{separator}\nMSG: a/B\n{inner}\n{separator}\nMSG: a/C\n{innermost}\n"
    with pytest.raises(BadDefinitionError, match=part):
        TypeRegistry().from_definition("a/A", text)


def test_usual_fixed_arrays_are_allowed() -> None:
    separator = "=" * 80
    text = f"B[2] b\nuint8[1048576] image\nC[] many\n{separator}\nMSG: a/B\nC[5] c\n{separator}\nMSG: a/C\n"
    assert len(TypeRegistry().from_definition("a/A", text).new().image) == 1 << 20


def test_an_unknown_type_is_told_with_the_place_that_needs_it(tmp_path: Path) -> None:
    messages = tmp_path / "mine" / "msg"
    messages.mkdir(parents=True)
    (messages / "Outer.msg").write_text("int8 x\nmine/Inner inner\n")
    types = TypeRegistry(PackageIndex([tmp_path]))
    with pytest.raises(UnknownTypeError) as caught:
        types.message("mine/Outer")
    assert caught.value.name == "mine/Inner"
    assert f"no file {messages / 'Inner.msg'}" in str(caught.value)
    assert f"{messages / 'Outer.msg'}:2" in str(caught.value)
    with pytest.raises(UnknownTypeError, match=f"no package nowhere on the package path \\({tmp_path}\\)"):
        types.service("nowhere/Thing")
    with pytest.raises(UnknownTypeError, match="named package/Type"):
        types.message("../../etc/passwd")


def test_a_package_wins_over_a_builtin_definition(tmp_path: Path) -> None:
    (tmp_path / "std_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "std_msgs" / "msg" / "String.msg").write_text("# mine\nstring data\nint8 more\n")
    string = TypeRegistry(PackageIndex([tmp_path])).message("std_msgs/String")
    assert [field.name for field in string.fields] == ["data", "more"]
    assert string.definition == "# mine\nstring data\nint8 more\n"


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "p" / "msg").mkdir(parents=True)
    (tmp_path / "p" / "msg" / "T.msg").write_bytes(b"string \xff\n")
    with pytest.raises(BadDefinitionError, match="not UTF-8"):
        TypeRegistry(PackageIndex([tmp_path])).message("p/T")


def test_an_empty_package_path_of_the_environment_is_no_path(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "p" / "srv").mkdir(parents=True)
    (tmp_path / "p" / "srv" / "S.srv").write_text("---\n")
    monkeypatch.setenv("RCE_PACKAGE_PATH", "")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    assert TypeRegistry().service("p/S").md5sum == "d41d8cd98f00b204e9800998ecf8427e"
