"""Loads launch files with ROS's own roslaunch, for comparison. A script for the machine's ``python3``.

Reads a JSON list ``[file, arguments]`` a line, and answers each with a line of JSON: ``{"parameters",
"nodes", "cleared"}``, or ``{"error"}``.
"""

from __future__ import annotations

import contextlib
import io
import json
import shlex
import sys
from typing import Any


def answer(file: str, arguments: list[str]) -> dict[str, Any]:
    import roslaunch.config
    import roslaunch.xmlloader

    config = roslaunch.config.ROSLaunchConfig()
    loader = roslaunch.xmlloader.XmlLoader()
    loader.ignore_unset_args = False
    try:
        loader.load(file, config, argv=arguments, verbose=False)
        return {
            "parameters": {name: one.value for name, one in config.params.items()},
            "nodes": [describe(node) for node in config.nodes],
            "cleared": [name.rstrip("/") or "/" for name in config.clear_params],
        }
    except Exception as error:  # noqa: BLE001 - whatever it raises, the file is refused
        return {"error": f"{type(error).__name__}: {error}"}


def describe(node: Any) -> dict[str, Any]:
    return {
        "name": node.namespace + node.name,
        "package": node.package,
        "type": node.type,
        "arguments": shlex.split(node.args),
        "remappings": [list(pair) for pair in node.remap_args],
        "environ": [list(pair) for pair in node.env_args],
        "prefix": shlex.split(node.launch_prefix or ""),
        "output": node.output or "log",
        "folder": node.cwd or "ROS_HOME",
        "respawn": node.respawn,
        "respawn_delay": node.respawn_delay,
        "required": node.required,
    }


def main() -> None:
    out = sys.stdout
    for line in sys.stdin:
        file, arguments = json.loads(line)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            found = answer(file, arguments)
        out.write(json.dumps(found) + "\n")
        out.flush()


if __name__ == "__main__":
    main()
