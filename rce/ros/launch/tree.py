"""The elements of a launch file, with their lines. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.parsers import expat

from rce.ros.launch.exceptions import LaunchFileError, Place


@dataclass(slots=True)
class Element:
    """An element of a launch file."""

    tag: str
    attributes: dict[str, str]
    place: Place
    children: list[Element] = field(default_factory=list)
    text: str = ""
    """Its own text, without that of its children."""


def parse_launch_file(data: bytes, file: str) -> Element:
    """Return the root element of a launch file.

    Args:
        data: The file's contents.
        file: Its path, for errors.

    Raises:
        LaunchFileError: It is not XML, or its root is not ``<launch>``.
    """
    stack: list[Element] = []
    roots: list[Element] = []
    # expat limits how far entities expand.
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, Place(file, parser.CurrentLineNumber, tag))
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)

    def characters(text: str) -> None:
        if stack:
            stack[-1].text += text

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: stack.pop()
    parser.CharacterDataHandler = characters
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        reason = f"not valid XML: {expat.ErrorString(error.code)} (column {error.offset + 1})"
        raise LaunchFileError(Place(file, error.lineno), reason) from error
    except (LookupError, ValueError) as error:  # of the encoding that the file names
        raise LaunchFileError(Place(file, 1), f"cannot be read: {error}") from error
    root = roots[0]
    if root.tag != "launch":
        raise LaunchFileError(root.place, "the root element must be <launch>")
    return root
