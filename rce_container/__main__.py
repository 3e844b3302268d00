"""The program ``rce-container``: the container task set."""

from __future__ import annotations

import shlex
import socket
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import uvloop

from rce.cli.options import (
    LOOPBACK,
    ControlPort,
    Development,
    LinkPort,
    Machine,
    MasterHost,
    SecretFile,
    Verbose,
    chosen,
    config_option,
    start_logging,
)
from rce.config.exceptions import RunDirError, SecretError
from rce.config.secret import load_secret
from rce.control.limits import MEGABYTE
from rce.guard.files import raise_file_limit
from rce_container.app import AUTO, RUNTIMES, App, package_path
from rce_container.archive import LOG_DAYS, LOG_SPACE
from rce_container.bundles.requirements import InstallerSettings
from rce_container.exceptions import ContainerError
from rce_container.settings import BUNDLE_SPACE, ContainerSettings
from rce_container.uids import FIRST_UID, UIDS

if TYPE_CHECKING:
    from rce.config.settings import EngineSettings

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


RuntimeName = Enum("RuntimeName", {name: name for name in (AUTO, *RUNTIMES)})  # type: ignore[misc]
_AUTO = RuntimeName(AUTO)


def _pick(settings: EngineSettings) -> dict[str, Any]:
    """Say which settings of a file are which parameters here."""
    picked = chosen(
        settings.container,
        {
            "bind": "bind",
            "link_port": "link_port",
            "grace": "grace",
            "labels": "label",
            "package_path": "package_path_",
            "images": "image",
            "slots": "slots",
            "slot_processes": "slot_processes",
            "first_uid": "first_uid",
            "uids": "uids",
            "log_days": "log_days",
            "allow_requirements": "allow_requirements",
            "pip_args": "pip_args",
        },
    )
    amounts = ("slot_memory", "home_size", "log_space", "bundle_space")
    in_bytes = chosen(settings.container, {name: name for name in amounts})
    picked |= {name: amount // MEGABYTE for name, amount in in_bytes.items()}
    if "runtime" in settings.container.model_fields_set:
        picked["runtime"] = settings.container.runtime.value
    if "state_dir" in settings.model_fields_set:
        picked["state_dir"] = settings.state_dir / "container"
    return picked


@app.command()
def container(
    master: MasterHost,
    control_port: ControlPort = 8080,
    link_port: LinkPort = None,
    bind: Annotated[str, typer.Option(help="Address to accept links on (default: all)")] = "",
    state_dir: Annotated[
        Path | None, typer.Option(help="Folder for name, logs and homes of the containers.")
    ] = None,
    runtime: Annotated[RuntimeName, typer.Option(help="How containers are made.")] = _AUTO,
    grace: Annotated[
        float,
        typer.Option(help="Seconds after which containers without this program end themselves.", min=0.1),
    ] = 30.0,
    image: Annotated[
        list[str] | None,
        typer.Option(
            metavar="IMAGE|DIR",
            help="Folder with a root file system that containers may have, beside podman's images; may be"
            " repeated. The first one, image or folder, is that of all containers of --runtime podman.",
        ),
    ] = None,
    package_path_: Annotated[
        list[Path] | None,
        typer.Option("--package-path", help="Folder with packages of nodes; may be repeated."),
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(help="What this machine has (special features of containers); may be repeated."),
    ] = None,
    slots: Annotated[
        int,
        typer.Option(help="Slots that this machine offers (default: one for each 64 MB of memory)", min=0),
    ] = 0,
    slot_memory: Annotated[
        int, typer.Option(metavar="MB", help="Memory of a container for each of its slots.", min=32)
    ] = 512,
    slot_processes: Annotated[
        int, typer.Option(help="Processes and threads of a container for each of its slots.", min=16)
    ] = 256,
    home_size: Annotated[
        int, typer.Option(metavar="MB", help="Size of a container's home, which is in memory.", min=1)
    ] = 256,
    first_uid: Annotated[
        int,
        typer.Option(
            help="As root: the first of the users that containers run as; they must belong to nobody else.",
            min=1,
        ),
    ] = FIRST_UID,
    uids: Annotated[int, typer.Option(help="As root: how many such users there are.", min=1)] = UIDS,
    log_days: Annotated[
        float, typer.Option(help="Days for which the logs of containers that ended are kept.", min=0.0)
    ] = LOG_DAYS,
    log_space: Annotated[
        int, typer.Option(metavar="MB", help="What those logs may take in all; the oldest go first.", min=0)
    ] = LOG_SPACE // MEGABYTE,
    bundle_space: Annotated[
        int, typer.Option(metavar="MB", help="What packages of users may take on the disk.", min=0)
    ] = BUNDLE_SPACE // MEGABYTE,
    allow_requirements: Annotated[
        bool,
        typer.Option("--allow-requirements", help="Install what users' packages ask for (requirements.txt)."),
    ] = False,
    pip_args: Annotated[
        str, typer.Option(help="More arguments for pip, such as '--index-url URL'; split as a shell does.")
    ] = "",
    name: Annotated[str, typer.Option(help="Name of this task set (default: made up once, then kept)")] = "",
    machine: Machine = "",
    secret_file: SecretFile = None,
    config: Annotated[Path | None, config_option(_pick)] = None,  # noqa: ARG001 - read before all others
    dev: Development = False,
    verbose: Verbose = False,
) -> None:
    """Run a container task set: makes the containers of the master at MASTER_IP on this machine."""
    start_logging(verbose=verbose)
    raise_file_limit()
    settings = ContainerSettings(
        machine=machine or socket.gethostname(),
        packages=package_path(package_path_ or ()),
        labels=tuple(label or ()),
        grace=grace,
        images=tuple(image or ()),
        slots=slots,
        slot_memory=slot_memory * MEGABYTE,
        slot_processes=slot_processes,
        home_bytes=home_size * MEGABYTE,
        first_uid=first_uid,
        uids=uids,
        log_days=log_days,
        log_space=log_space * MEGABYTE,
        bundle_space=bundle_space * MEGABYTE,
        requirements=InstallerSettings(pip_args=tuple(shlex.split(pip_args))) if allow_requirements else None,
    )
    try:
        program = App(
            master=master,
            control_port=control_port,
            secret=load_secret(secret_file, dev=dev),
            settings=settings,
            runtime=runtime.value,
            link_port=link_port,
            host=bind or (LOOPBACK if dev else ""),
            name=name,
            state_dir=state_dir,
        )
        uvloop.run(program.run(_announce))
    except (SecretError, RunDirError, ContainerError, OSError) as error:
        typer.echo(f"rce-container: {error}", err=True)
        raise typer.Exit(1) from error


def _announce(name: str, runtime: str) -> None:
    print(f"rce-container ready: {name} runtime={runtime}", flush=True)  # noqa: T201 - what other programs wait for


def main() -> None:
    """Run the program."""
    app()


if __name__ == "__main__":
    main()
