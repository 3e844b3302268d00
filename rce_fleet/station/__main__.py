"""``rce ui CONFIG``, ``rce ui --ros-master URI``: the operator station as a program."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import sys
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Annotated, Any, Protocol
from urllib.parse import urlsplit

import typer
import uvloop

from rce.aio.tasks import errors_in
from rce.cli.options import Authority, CertificateName, Certificates, Tls, TlsCert, TlsKey, tls_of
from rce.cli.program_files import from_file
from rce.config.client import ClientConfig, load
from rce.config.exceptions import ConfigError, Fault
from rce.config.folders import default_state_dir
from rce.config.logs import start_logging
from rce.masters import split_addresses
from rce.own_process import end_signals
from rce.ros.errors import NodeClosedError
from rce.ros.names import parse_arguments
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.tls.choice import ENGINE, TlsChoice, default_folder, plain_warning
from rce.tls.faults import CertificateError
from rce.tls.identity import Context, client_contexts
from rce.tls.names import CertificateNames
from rce.web.origin import ServerNames
from rce.web.server import HttpServer
from rce_client.exceptions import RefusedError
from rce_fleet.station.authentication import Authenticator, TokenAuthenticator
from rce_fleet.station.commands.control import RobotControl
from rce_fleet.station.commands.desired_stops import DesiredStops, stops_file
from rce_fleet.station.commands.manual_mode import ManualModes
from rce_fleet.station.commands.owed_modes import OwedModes, modes_file
from rce_fleet.station.commands.sources import CommandSource, EngineCommandSource, RosCommandSource
from rce_fleet.station.commands.stop_modes import StopModes, stop_modes_file
from rce_fleet.station.engine_authenticator import EngineAuthenticator, StationAccount
from rce_fleet.station.engine_planner_client import EnginePlannerClient
from rce_fleet.station.engine_watch import EngineWatch
from rce_fleet.station.feed import Feed
from rce_fleet.station.figures import FigureRecorder
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.graph_watch import GraphWatch
from rce_fleet.station.layers.engine_source import EngineLayerSource
from rce_fleet.station.layers.hub import LayerHub
from rce_fleet.station.layers.ros_source import RosLayerSource
from rce_fleet.station.layers.sources import LayerSource
from rce_fleet.station.masters_watch import DemoProcess, MastersWatch, masters_text
from rce_fleet.station.planner_client import PlannerClient
from rce_fleet.station.private_files import KeptInFile
from rce_fleet.station.recording import Recorder, open_records, replay_file
from rce_fleet.station.ros_planner_client import RosPlannerClient
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView
from rce_fleet.station.webhook_store import webhooks_file
from rce_fleet.station.world_link import WorldLink, states_text, things_text

_log = logging.getLogger(__name__)

PORT = 9080


@from_file("ui", leave_out=("demo",), shared=tls_of)
def ui(
    config: Annotated[
        Path | None, typer.Argument(help="The operator's config: user, robotID, the planner's container.")
    ] = None,
    ros_master: Annotated[
        str,
        typer.Option(help="Instead of CONFIG: ROS master of a planner that runs without the engine."),
    ] = "",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page and the API; 0: any free port.")
    ] = PORT,
    bind: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    public_name: Annotated[
        list[str] | None,
        typer.Option(help="Additional host name of the station; may be repeated."),
    ] = None,
    token: Annotated[
        str,
        typer.Option(
            envvar="RCE_STATION_TOKEN",
            help="With --ros-master: the token that requests must carry.",
        ),
    ] = "",
    login: Annotated[
        bool | None,
        typer.Option(
            help="Ask for a login as a user of the engine"
            " (default: unless station and engine are on loopback)",
            show_default=False,
        ),
    ] = None,
    history: Annotated[
        Path | None,
        typer.Option(help="File that keeps replays (default: those of the last day, in --state-dir)."),
    ] = None,
    world: Annotated[
        str, typer.Option(help="ROS master of the simulated world in which the fleet drives (rce sim).")
    ] = "",
    state_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of webhooks, emergency stops, modes and replays [STATE/station]."),
    ] = None,
    demo: Annotated[bool, typer.Option("--demo", hidden=True)] = False,
    tls: Tls = False,
    certificates: Certificates = None,
    certificate: CertificateName = ENGINE,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    authority: Authority = None,
) -> None:
    """Serve the operator's page and API of a fleet; with CONFIG, the planner runs in the engine."""
    start_logging(logging.WARNING)
    if (config is None) == (not ros_master):
        raise typer.BadParameter("give either CONFIG or --ros-master")
    try:
        backend = RosBackend(ros_master) if config is None else EngineBackend(load(config), authority)
        chosen = TlsChoice(
            enabled=tls,
            folder=certificates or default_folder(),
            name=certificate,
            certificate=tls_cert,
            key=tls_key,
        )
        identity = chosen.for_clients()
    except (ConfigError, CertificateError) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from None
    if identity is None and (text := plain_warning("the logins of the station travel", bind)):
        _log.warning("%s", text)
    authenticator = _authenticator(backend, bind, token, login)
    try:
        names = ServerNames(bind, public_name or (), CertificateNames(identity))
        server_tls = identity.server if identity else None
        place = state_dir or default_state_dir() / "station"
        uvloop.run(
            serve(
                *(backend, bind, port, authenticator, names, server_tls, history, world),
                webhooks=webhooks_file(place, backend.fleet),
                stops=stops_file(place, backend.fleet),
                modes=modes_file(place, backend.fleet),
                stop_modes=stop_modes_file(place, backend.fleet),
                replay=replay_file(place, backend.fleet),
                kill_leader=DemoProcess().kill_leader if demo else None,
            )
        )
    except* (RefusedError, NodeClosedError) as group:
        typer.echo(f"rce ui: {next(errors_in(group))}", err=True)
        raise typer.Exit(1) from None
    except* OSError as group:
        typer.echo(f"rce ui: cannot listen on {bind}:{port}: {next(errors_in(group))}", err=True)
        raise typer.Exit(1) from None


def _authenticator(
    backend: EngineBackend | RosBackend, bind: str, token: str, login: bool | None
) -> Authenticator:
    """Choose how users are authenticated.

    Raises:
        typer.BadParameter: The options would let every computer control the fleet, or contradict each other.
    """
    if isinstance(backend, RosBackend):
        if login:
            raise typer.BadParameter(
                "--login needs the user accounts of an engine; with --ros-master, give a --token"
            )
        if not token and not _is_loopback(bind):
            raise typer.BadParameter(f"with --bind {bind} other computers reach the station; give a --token")
        return TokenAuthenticator(token)
    if token:
        raise typer.BadParameter(
            "--token is for --ros-master; with CONFIG, programs send tokens of the engine's users (rce token)"
            " and people log in at the page"
        )
    account = backend.account
    asks = login if login is not None else not (_is_loopback(bind) and _is_here(account.url))
    if not asks and not _is_loopback(bind):
        raise typer.BadParameter(
            f"--no-login with --bind {bind} would let every computer in the network control the fleet;"
            " leave out one of the two"
        )
    return EngineAuthenticator(account, allow_anonymous=not asks)


def _is_here(urls: str) -> bool:
    """Return whether all masters are on this machine."""
    return all(_is_loopback(urlsplit(url).hostname or "") for url in split_addresses(urls))


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Backend(Protocol):
    """Where the planner runs: in the engine, or in a ROS graph."""

    @property
    def client(self) -> PlannerClient:
        """The client of the planner."""

    @property
    def fleet(self) -> str:
        """What tells the fleet from others."""

    @property
    def layers(self) -> LayerSource:
        """Where layers come from."""

    @property
    def commands(self) -> CommandSource:
        """What publishes on robots' topics."""

    async def watch(self, on_state: Callable[[dict[str, Any]], None]) -> None:
        """Call ``on_state`` with the state of engine or graph until cancelled."""

    def masters(self, on_state: Callable[[dict[str, Any]], None], *, kills: bool) -> MastersWatch | None:
        """Return what calls ``on_state`` with who leads; None if there are not several masters."""


class EngineBackend:
    """The planner runs in a container of the engine."""

    def __init__(self, config: ClientConfig, authority: Path | None = None) -> None:
        self._tls = client_contexts(authority or config.authority_file)
        password = config.password.get_secret_value()
        if not password:
            raise ConfigError(
                "station", [Fault("token", "a token is for robots; the station needs the user's password")]
            )
        self.account = account = StationAccount(config.url, config.user, password, self._tls)
        self.fleet = f"{config.url} {config.user} {config.robot}"
        self.client = EnginePlannerClient(config, self._tls)
        self._on_state: Callable[[dict[str, Any]], None] = _ignore
        self._watch = EngineWatch(
            account.url, account.user, account.password, tls=self._tls, on_state=self._take
        )
        self.layers = EngineLayerSource(lambda: self.client.connection, self._watch.read_items)
        self.commands = EngineCommandSource(lambda: self.client.connection, self._watch.read_items)

    async def watch(self, on_state: Callable[[dict[str, Any]], None]) -> None:
        """Call ``on_state`` with the engine's state until cancelled; restart nodes that ended."""
        self._on_state = on_state
        await self._watch.run()

    def masters(self, on_state: Callable[[dict[str, Any]], None], *, kills: bool) -> MastersWatch | None:
        """Return what calls ``on_state`` with who leads; None if the config names one master."""
        if len(split_addresses(self.account.url)) == 1:
            return None
        return MastersWatch(self.account.url, tls=self._tls, on_state=on_state, kills=kills)

    def _take(self, state: dict[str, Any]) -> None:
        self._on_state(state)
        self.client.on_engine(state)


def _ignore(state: dict[str, Any]) -> None:
    del state


class RosBackend:
    """The planner runs in a ROS graph without the engine."""

    def __init__(self, master_uri: str) -> None:
        types = TypeRegistry(PackageIndex.from_environ())
        self.client = RosPlannerClient(master_uri, types)
        self.layers = RosLayerSource(master_uri, types)
        self.commands = RosCommandSource(self.layers)
        self.fleet = self._master_uri = master_uri

    async def watch(self, on_state: Callable[[dict[str, Any]], None]) -> None:
        """Call ``on_state`` with the graph's nodes until cancelled."""
        await GraphWatch(self._master_uri, on_state=on_state).run()

    def masters(self, on_state: Callable[[dict[str, Any]], None], *, kills: bool) -> MastersWatch | None:
        """Return None: a ROS graph has one master."""
        del on_state, kills
        return None


async def serve(
    backend: Backend,
    bind: str,
    port: int,
    authenticator: Authenticator,
    names: ServerNames,
    tls: Context | None = None,
    history: Path | None = None,
    world: str = "",
    *,
    webhooks: Path | None = None,
    stops: Path | None = None,
    modes: Path | None = None,
    stop_modes: Path | None = None,
    replay: Path | None = None,
    kill_leader: Callable[[], None] | None = None,
) -> None:
    """Serve until SIGINT or SIGTERM."""
    view = FleetView()
    feed = Feed(view)
    fleet = FleetLink(
        backend.client,
        view,
        on_change=feed.on_change,
        on_pose=feed.on_pose,
        on_event=feed.on_event,
        on_fleet_event=lambda text: station.fleet_api.feed.take(text),  # noqa: PLW0108 - made below
        on_planner=feed.on_planner,
    )
    stop = asyncio.Event()
    for number in end_signals():
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    layers = LayerHub(backend.layers, view, TypeRegistry(PackageIndex.from_environ()))
    desired_stops = DesiredStops(stops)

    def tell_control() -> None:
        feed.on_control(control.stopped, control.driven, control.fleet_stopped_by, control.undelivered)
        modes_of_stops.wake()

    control = RobotControl(backend.commands, view.robot_ids, tell_control, desired_stops)
    owed_to_stopped = OwedModes(stop_modes)
    modes_of_stops = StopModes(fleet, view, control, owed_to_stopped)
    types = TypeRegistry(PackageIndex.from_environ())
    link = (
        WorldLink(
            world,
            types,
            lambda states: feed.pages.send("world", states_text(states)),
            feed.pages.are_open,
            lambda things: feed.pages.send("things", things_text(things)),
        )
        if world
        else None
    )
    owed_modes = OwedModes(modes)
    manual_modes = ManualModes(fleet, view, owed_modes)
    recorder = Recorder(view, open_records(history, replay), feed.on_event)
    station = Station(
        view,
        fleet,
        feed.pages,
        authenticator=authenticator,
        names=names,
        layers=layers,
        control=control,
        records=recorder.records,
        world=link,
        webhooks=webhooks,
        kill_leader=kill_leader,
        modes=manual_modes,
    )
    masters = backend.masters(
        lambda state: feed.pages.send("masters", masters_text(state)), kills=kill_leader is not None
    )
    figures = FigureRecorder(view, recorder.records, station.fleet_api.statistics)
    try:
        await station.fleet_api.load()
    except OSError as error:
        typer.echo(f"rce ui: {error}", err=True)
        raise typer.Exit(1) from None
    await _load(desired_stops, stops, "emergency stops of before")
    await _load(owed_modes, modes, "robots that were driven by hand before")
    await _load(owed_to_stopped, stop_modes, "modes of robots before they were stopped")
    async with AsyncExitStack() as stack:
        stack.push_async_callback(layers.close)
        stack.push_async_callback(control.close)
        stack.callback(recorder.records.close)
        if isinstance(authenticator, EngineAuthenticator):
            await stack.enter_async_context(authenticator)
        server = await stack.enter_async_context(HttpServer(station.make_app(), bind, port, tls))

        async def announce() -> None:
            typer.echo(f"rce ui ready: {server.url}")

        async def ended() -> None:
            await stop.wait()
            await station.end_drives()  # the planner can be asked only before the rest ends

        await _until(
            ended,
            lambda: fleet.run(announce),
            feed.run,
            lambda: backend.watch(feed.on_engine),
            control.run,
            modes_of_stops.run,
            manual_modes.run,
            recorder.run,
            figures.run,
            *([link.run] if link else []),
            *([masters.run] if masters else []),
            station.fleet_api.run,
        )


async def _load(kept: KeptInFile[Any], file: Path | None, what: str) -> None:
    """Read what an earlier station kept; without it this one begins anew."""
    try:
        await asyncio.to_thread(kept.load)
    except (OSError, ValueError) as error:
        _log.error("%s are not known: %s: %s", what, file, error)


async def _until(done: Callable[[], Any], *work: Callable[[], Any]) -> None:
    """Run ``work`` until ``done`` returns; then cancel it and wait for it to end."""
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(each()) for each in work]
        await done()
        for task in tasks:
            task.cancel()


def main() -> None:
    """Run the program."""
    typer.run(ui)


def node() -> None:
    """Run the program as a node of a launch file; its name and remappings have no effect."""
    sys.argv[1:] = parse_arguments(sys.argv[1:]).rest
    main()


if __name__ == "__main__":
    main()
