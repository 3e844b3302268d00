"""The section ``master`` of the engine's settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from msgspec import Meta

from rce.config.fields import Cores, Finite, Host, Memory, Networks, Port, Seconds, Section, Setting, Store

ANYWHERE = "0.0.0.0"  # noqa: S104 - an engine serves other machines unless in development mode


class MasterSettings(Section, frozen=True, kw_only=True):
    """The Master Task Set, `rce-master`."""

    replicas: Annotated[
        int,
        Setting(
            "Masters of `rce up`: 3 or 5 share an etcd, which is run too, to try how one fails.",
            option="",
            up="replicas",
        ),
    ] = 1
    bind: Annotated[Host, Setting("Address to listen on.")] = ANYWHERE
    http_port: Annotated[Port, Setting("Port of clients, REST API and metrics.", up="http-port")] = 9000
    control_port: Annotated[Port, Setting("Port of task sets.", up="control-port")] = 8080
    state_dir: Annotated[
        Path | None,
        Setting("Folder of users and desired state.", unset="folder `master` in the engine's state folder"),
    ] = None
    store: Annotated[
        Store,
        Setting(
            "Where users and desired state are: `sqlite:FOLDER`, or for several masters"
            " `etcd://HOST:2379,HOST:2379,...` (`etcds://` with TLS; `/PREFIX` may follow).",
            unset="SQLite in `state_dir`",
        ),
    ] = ""
    lease: Annotated[
        Finite,
        Meta(ge=2, le=60),
        Setting("Seconds; with etcd: how long a leading master that fell silent keeps the lead, 2 to 60."),
    ] = 3.0
    advertise: Annotated[
        Host,
        Setting(
            "With etcd: host name or address by which the other masters reach this one, to forward requests.",
            unset="`bind`, or the address on the way to etcd",
            example="10.0.0.1",
        ),
    ] = ""
    origins: Annotated[
        tuple[str, ...],
        Setting("Origins whose web pages may use the server.", option="allow-origin"),
    ] = ()
    public_names: Annotated[
        tuple[str, ...],
        Setting(
            "Names by which the server may be asked for, beside its addresses, host name and `localhost`.",
            option="public-name",
        ),
    ] = ()
    robot_grace: Annotated[
        Seconds, Setting("How long a robot that is away keeps its interfaces and connections.")
    ] = 60.0
    container_grace: Annotated[
        Seconds,
        Setting("How long a container task set may be away until its containers are placed elsewhere."),
    ] = 30.0
    token_lifetime: Annotated[Seconds, Setting("How long an API token is valid.")] = 30 * 86400.0
    trusted_proxies: Annotated[
        Networks,
        Setting(
            "Addresses or networks of proxies whose `X-Forwarded-For` is believed.", option="trusted-proxy"
        ),
    ] = ()
    requests_per_second: Annotated[
        float,
        Meta(ge=0),
        Setting(
            "Requests of one user each second over REST, and as many over WebSockets; 0: no limit. No limit "
            "of one user applies to administrators, but those of packages."
        ),
    ] = 100.0
    request_burst: Annotated[
        int, Meta(ge=1), Setting("Requests of one user that may come at once, after a rest.")
    ] = 2000
    max_streams: Annotated[
        int, Meta(ge=0), Setting("Streams of events and usage of one user at a time; 0: no limit.")
    ] = 64
    max_log_reads: Annotated[int, Meta(ge=1), Setting("Reads of logs of one user at a time.")] = 4
    user_share: Annotated[
        float,
        Meta(ge=0, le=1),
        Setting(
            "Share of the slots, cores and memory of all machines that the containers of one user may take "
            "together; 0: no limit."
        ),
    ] = 0.75
    max_containers: Annotated[int, Meta(ge=0), Setting("Containers of one user; 0: no limit.")] = 200
    max_packages: Annotated[
        int, Meta(ge=0), Setting("Versions of packages that one user may keep; 0: no limit.")
    ] = 200
    max_disk: Annotated[
        Memory, Setting("What packages, volumes and saved states of one user may take; 0: no limit.")
    ] = 4 << 30
    max_slots: Annotated[
        int,
        Meta(ge=0),
        Setting("Slots that the containers of one user may take together; 0: no limit."),
    ] = 0
    max_cpu: Annotated[
        Cores, Setting("Cores that the containers of one user may ask for together; 0: no limit.")
    ] = 0.0
    max_memory: Annotated[
        Memory, Setting("Memory that the containers of one user may ask for together; 0: no limit.")
    ] = 0
