"""The program ``rce-container``: the container task set."""

from __future__ import annotations

import shlex
import socket
from typing import Annotated

import typer
import uvloop

from rce.cli.options import Verbose, start_logging
from rce.cli.settings import COMMON, SettingsOptions
from rce.config.exceptions import RunDirError, SecretError
from rce.config.secret import load_secret
from rce.config.settings import EngineSettings
from rce.guard.files import raise_file_limit
from rce.tls.choice import TlsChoice
from rce.tls.exceptions import CertificateError
from rce_container.app import App, package_path
from rce_container.bundles.requirements import InstallerSettings
from rce_container.ending import end_containers
from rce_container.exceptions import ContainerError
from rce_container.settings import ContainerSettings

TLS = ("tls.enabled", "tls.certificates", "tls.name")
OPTIONS = SettingsOptions("container", "master.control_port", *TLS, *COMMON, master=True)
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
@OPTIONS.given("rce-container")
def container(
    engine: EngineSettings,
    *,
    end: Annotated[
        bool, typer.Option("--end", help="End the containers that a killed rce-container left, and stop.")
    ] = False,
    verbose: Verbose = False,
) -> None:
    """Run a container task set: makes the containers of the master at MASTER_IP on this machine."""
    start_logging(engine, "rce-container", verbose=verbose)
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
            return
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
        uvloop.run(program.run(_announce))
    except (SecretError, RunDirError, ContainerError, CertificateError, OSError) as error:
        typer.echo(f"rce-container: {error}", err=True)
        raise typer.Exit(1) from error


def _announce(name: str, runtime: str) -> None:
    print(f"rce-container ready: {name} runtime={runtime}", flush=True)  # noqa: T201 - what other programs wait for


def main() -> None:
    """Run the program."""
    app()


if __name__ == "__main__":
    main()
