"""Runs ``rce-robot`` with settings that have been read."""

from __future__ import annotations

import sys

import uvloop

from rce.config import EngineSettings, LogFileError, RunDirError, SecretError, load_secret, log_as
from rce.own_process import raise_file_limit
from rce.ros.tcpros.allocator import keep_large_blocks
from rce.tls import CertificateError
from rce.tls.choice import TlsChoice
from rce_robot.app import App
from rce_robot.settings import RobotSettings


def run(engine: EngineSettings, *, verbose: bool = False) -> int:
    """Run a robot task set until it is told to end.

    Args:
        engine: The settings.
        verbose: Log all messages.

    Returns:
        The exit code; faults were printed.
    """
    try:
        log_as("rce-robot", engine, verbose=verbose)
    except LogFileError as error:
        print(f"rce-robot: {error}", file=sys.stderr)  # noqa: T201 - for the shell
        return 1
    own = engine.robot
    settings = RobotSettings(
        host=own.bind,
        ws_port=own.ws_port,
        link_port=own.link_port,
        public_host=own.public_host,
        public_url=own.public_url,
        machine=engine.machine,
        origins=own.origins,
        trusted_proxies=own.trusted_proxies,
        user_memory=own.user_memory,
        memory=own.memory,
        unauthenticated_per_address=own.strangers,
    )
    keep_large_blocks()
    raise_file_limit()
    try:
        secret = load_secret(engine.secret_file, dev=engine.dev)
        program = App(
            master=engine.master_host,
            control_port=engine.master.control_port,
            secret=secret,
            packages=engine.container.package_path,
            settings=settings,
            tls=TlsChoice.of(engine),
        )
        uvloop.run(program.run(_announce))
    except (SecretError, RunDirError, CertificateError, OSError) as error:
        print(f"rce-robot: {error}", file=sys.stderr)  # noqa: T201 - for the shell
        return 1
    return 0


def _announce(url: str) -> None:
    print(f"rce-robot ready: {url}", flush=True)  # noqa: T201 - read by other programs
