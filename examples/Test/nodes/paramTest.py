#!/usr/bin/env python3
"""Answers a service call with the parameters int, str, float and bool. Its one argument begins the answer."""

from __future__ import annotations

import sys

from rce.ros.errors import ParameterMissingError, ServiceFaultError
from rce.ros.names import parse_arguments
from rce.ros.node import Node, run

PARAMETERS = ("int", "str", "float", "bool")


async def main(label: str) -> None:
    """Answer until the node is told to stop."""
    async with Node("paramTest") as node:

        async def answer(_request: object) -> dict[str, str]:
            try:
                values = [f"{name}={await node.get_param(name)}" for name in PARAMETERS]
            except ParameterMissingError as error:
                raise ServiceFaultError("parameterTest", str(error)) from error
            return {"msg": f"{label}: {' '.join(values)}"}

        await node.advertise_service("parameterTest", "Test/ParameterTest", answer)
        await node.spin()


if __name__ == "__main__":
    own = parse_arguments(sys.argv[1:]).rest
    if len(own) != 1:
        sys.exit("usage: paramTest.py LABEL")
    run(main(own[0]))
