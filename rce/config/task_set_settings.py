"""The sections ``robot`` and ``container`` of the engine's settings."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from rce.config.fields import Finite, Host, Memory, Networks, Port, Section, Setting, choice
from rce.config.master_settings import ANYWHERE


class Runtime(Enum):
    """How containers are isolated."""

    AUTO = "auto"
    """The strongest isolation that this machine supports."""
    NAMESPACE = "namespace"
    PODMAN = "podman"
    """All containers are of images."""
    PROCESS = "process"


class RobotSettings(Section, frozen=True, kw_only=True):
    """The Robot Task Set, `rce-robot`."""

    count: Annotated[
        int,
        Meta(ge=1, le=64),
        Setting(
            "Robot processes of `rce up`; each further one takes the next ports.", option="", up="robots"
        ),
    ] = 1
    bind: Annotated[Host, Setting("Address to listen on.")] = ANYWHERE
    ws_port: Annotated[Port, Setting("Port of robots' WebSockets.", up="ws-port")] = 9010
    link_port: Annotated[
        Port | None,
        Setting(
            "Port of links from other machines.",
            up="robot-link-port",
            unset="10030, or a free one where that is taken",
        ),
    ] = None
    public_host: Annotated[
        Host,
        Setting(
            "Name or address by which clients and other machines reach this one.",
            up="public-host",
            unset="its address towards the master",
            example="cloud.example.org",
        ),
    ] = ""
    public_url: Annotated[
        str,
        Meta(pattern=r"^(wss?://.+)?$"),
        Setting(
            "URL that clients are sent to, where a proxy stands in front.",
            up="public-url",
            unset="made of `public_host` and `ws_port`",
            example="wss://cloud.example.org/",
        ),
    ] = ""
    origins: Annotated[
        tuple[str, ...], Setting("Origins whose web pages may connect; `*` is any.", option="origin")
    ] = ()
    trusted_proxies: Annotated[
        Networks,
        Setting(
            "Addresses or networks of proxies whose `X-Forwarded-For` is believed.", option="trusted-proxy"
        ),
    ] = ()
    user_memory: Annotated[
        Memory,
        Meta(ge=1 << 20),
        Setting(
            "Messages that may wait for all robots of a user at one robot process; beyond it the oldest are"
            " dropped."
        ),
    ] = 512 << 20
    memory: Annotated[
        Memory,
        Setting(
            "The same for all users; 0: half of the machine's memory. The robot processes of `rce up` share"
            " it equally."
        ),
    ] = 0
    strangers: Annotated[
        int, Meta(ge=1), Setting("Connections from one address that have not logged in yet.")
    ] = 256


class ContainerSettings(Section, frozen=True, kw_only=True):
    """The Container Task Set, `rce-container`."""

    bind: Annotated[Host, Setting("Address to accept links on.", unset="all")] = ""
    link_port: Annotated[
        Port | None,
        Setting(
            "Port of links from other machines.",
            up="container-link-port",
            unset="10030, or a free one where that is taken; 10031 with `rce up`",
        ),
    ] = None
    name: Annotated[str, Setting("Name of this task set.", unset="made up once, then kept")] = ""
    state_dir: Annotated[
        Path | None,
        Setting(
            "Folder of containers' logs and homes, and of packages.",
            unset="folder `container` in the engine's state folder",
        ),
    ] = None
    runtime: Annotated[
        Runtime,
        choice(Runtime),
        Setting("How containers are isolated; `process` does not isolate them.", up="runtime"),
    ] = Runtime.AUTO
    package_path: Annotated[
        tuple[Path, ...],
        Setting(
            "Folders with ROS packages, the first match wins; the shipped examples come last.",
            up="package-path",
        ),
    ] = ()
    grace: Annotated[
        Finite,
        Meta(ge=0.1),
        Setting("How long containers wait for a manager that was killed until they end themselves."),
    ] = 30.0
    labels: Annotated[
        tuple[str, ...],
        Setting("What this machine has; containers ask for it as `specialFeatures`.", option="label"),
    ] = ()
    images: Annotated[
        tuple[str, ...],
        Setting(
            "Root file systems that containers may have, beside podman's images; the first one, image or"
            " folder, is that of all containers of `runtime: podman`.",
            option="image",
        ),
    ] = ()
    offer_images: Annotated[
        bool,
        Setting(
            "Offer containers with an image beside those of `runtime`, if podman works here; the program"
            " tries it at its start.",
            up="offer-images",
        ),
    ] = True
    slots: Annotated[
        int,
        Meta(ge=0),
        Setting("Slots that this machine offers in all; 0: one for each 64 MB of its memory."),
    ] = 0
    slot_memory: Annotated[
        Memory, Meta(ge=32 << 20), Setting("Memory of a container for each of its slots.")
    ] = 512 << 20
    slot_processes: Annotated[
        int, Meta(ge=16), Setting("Processes and threads of a container for each of its slots.")
    ] = 256
    home_size: Annotated[
        Memory, Meta(ge=1 << 20), Setting("Size of a container's home, which is in memory.")
    ] = 256 << 20
    first_uid: Annotated[
        int,
        Meta(ge=1),
        Setting("As root: the first of the user IDs that containers run as; no other user may have them."),
    ] = 700_000
    uids: Annotated[int, Meta(ge=1), Setting("How many such user IDs there are.")] = 10_000
    log_days: Annotated[
        Finite, Meta(ge=0), Setting("Days for which the logs of containers that ended are kept.")
    ] = 3.0
    log_space: Annotated[Memory, Setting("What those logs may take on the disk; the oldest go first.")] = (
        1 << 30
    )
    bundle_space: Annotated[Memory, Setting("What users' packages may take on the disk.")] = 4 << 30
    allow_requirements: Annotated[
        bool, Setting("Install what users' packages ask for in a `requirements.txt`.")
    ] = False
    pip_args: Annotated[
        str, Setting("More arguments for pip, such as `--index-url URL`; split as a shell does.")
    ] = ""
