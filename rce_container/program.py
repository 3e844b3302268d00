"""Runs ``rce-container`` with settings that have been read."""

from __future__ import annotations

import shlex
import socket
import sys

import uvloop

from rce.config import EngineSettings, LogFileError, RunDirError, SecretError, load_secret, log_as
from rce.own_process import raise_file_limit
from rce.tls import CertificateError
from rce.tls.choice import TlsChoice
from rce_container.app import App, package_path
from rce_container.ending import end_containers
from rce_container.exceptions import ContainerError
from rce_container.packages.requirements import InstallerSettings
from rce_container.renewal import renew
from rce_container.settings import ContainerSettings


def run(engine: EngineSettings, *, end: bool = False, check: bool = False, verbose: bool = False) -> int:
    """Run a container task set until it is told to end.

    Args:
        engine: The settings.
        end: Only end the containers that a killed ``rce-container`` left.
        check: Only check whether it could start with these settings.
        verbose: Log all messages.

    Returns:
        The exit code; faults were printed.
    """
    try:
        if not check:  # the file belongs to the program that runs
            log_as("rce-container", engine, verbose=verbose)
    except LogFileError as error:
        print(f"rce-container: {error}", file=sys.stderr)  # noqa: T201 - for the shell
        return 1
    raise_file_limit()
    own = engine.container
    pip = InstallerSettings(pip_args=tuple(shlex.split(own.pip_args)))
    settings = ContainerSettings(
        machine=engine.machine or socket.gethostname(),
        packages=package_path(own.package_path),
        labels=own.labels,
        tls=engine.tls.enabled,
        grace=own.grace,
        images=own.images,
        offer_images=own.offer_images,
        slots=own.slots,
        slot_memory=own.slot_memory,
        slot_processes=own.slot_processes,
        home_bytes=own.home_size,
        first_uid=own.first_uid,
        uids=own.uids,
        log_days=own.log_days,
        log_space=own.log_space,
        bundle_space=own.bundle_space,
        requirements=pip if own.allow_requirements else None,
    )
    try:
        if end:
            uvloop.run(end_containers(settings, engine.container_state))
            return 0
        program = App(
            master=engine.master_host,
            control_port=engine.master.control_port,
            secret=load_secret(engine.secret_file, dev=engine.dev),
            settings=settings,
            runtime=own.runtime.value,
            link_port=own.link_port,
            host=own.bind,
            name=own.name,
            state_dir=engine.container_state,
            tls=TlsChoice.of(engine),
        )
        if check:
            program.check()
            return 0
        if uvloop.run(program.run(_announce)):
            renew()
    except (SecretError, RunDirError, ContainerError, CertificateError, OSError) as error:
        print(f"rce-container: {error}", file=sys.stderr)  # noqa: T201 - for the shell
        return 1
    return 0


def _announce(name: str, runtime: str) -> None:
    print(f"rce-container ready: {name} runtime={runtime}", flush=True)  # noqa: T201 - read by other programs
