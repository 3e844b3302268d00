"""Puts the task set together and runs it until it is told to stop."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import secrets
import socket
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce.config import Secret, ShippedFileError, examples_dir, run_dir
from rce.control import LinkAddress, MachineInfo
from rce.control_channel.channel import TaskSetChannel
from rce.guard import Lobby
from rce.link import LinkHub, in_url, is_any, listen_on, own_address, remove_stale_sockets, socket_name
from rce.lookups import LOOKUPS
from rce.masters import Masters, split_addresses, split_port
from rce.own_process import end_signals, listening, machine_memory
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.tls.choice import TlsChoice
from rce.tls.expiry import name_warning
from rce_robot.conversion import ConversionPool
from rce_robot.doors.client.door import ClientDoor
from rce_robot.factory import FormFactory
from rce_robot.settings import RobotSettings
from rce_robot.taskset import RobotTaskSet

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence
    from pathlib import Path

    from rce_robot.doors.base import Door

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class App:
    """A robot task set that is to be run."""

    master: str
    """Host of the master, or ``HOST:PORT``; several are separated by commas."""
    control_port: int
    secret: Secret
    packages: Sequence[Path]
    settings: RobotSettings
    tls: TlsChoice = field(default_factory=TlsChoice)

    async def run(self, ready: Callable[[str], None]) -> None:
        """Run until SIGINT or SIGTERM.

        Args:
            ready: Called with the WebSocket URL when robots can connect.

        Raises:
            OSError: A port cannot be taken.
            CertificateError: The certificates cannot be used.
        """
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in end_signals():
            loop.add_signal_handler(number, stop.set)
        async with self.started(ready, stop):
            # The present objects stay; each garbage collection of them would take 20 ms.
            gc.collect()
            gc.freeze()
            await stop.wait()

    @property
    def _places(self) -> list[tuple[str, int]]:
        """Host and control port of each master."""
        return [split_port(address, self.control_port) for address in split_addresses(self.master)]

    @contextlib.asynccontextmanager
    async def started(
        self, ready: Callable[[str], None], stop: asyncio.Event | None = None
    ) -> AsyncIterator[None]:
        """Run as long as the context lasts.

        Args:
            ready: As for :meth:`run`.
            stop: Set when the context is to be left at once: then its start does not wait.
        """
        settings = self.settings
        for_robots, for_task_sets = self.tls.for_clients(), self.tls.for_task_sets()
        machine = settings.machine or socket.gethostname()
        reach = settings.public_host or settings.host
        if is_any(reach):
            reach = await own_address(*self._places[0], stop)
        name = f"robot_{secrets.token_hex(4)}"
        packages = _package_index(self.packages)
        types = TypeRegistry(packages)
        pool = ConversionPool(packages.path, settings.conversion)
        hub = LinkHub(machine, tls=self.tls.enabled)
        try:
            address = await _listen(hub, machine, name, reach, settings, tls=self.tls.enabled)
            with listening(settings.host, settings.ws_port, "--ws-port"):
                listener = await _bind(settings.host, settings.ws_port)
            port: int = listener.getsockname()[1]
            scheme = "ws" if for_robots is None else "wss"
            url = settings.public_url or f"{scheme}://{in_url(reach)}:{port}/"
            to_robots = "" if url.startswith("wss:") else "robots' passwords and messages travel"
            _warn(self.tls.plain_warning(to_robots, settings.host))
            if for_robots is not None and not settings.public_url:
                _warn(name_warning(for_robots, reach))
            info = MachineInfo(name=machine, cores=os.cpu_count() or 0, memory=machine_memory())
            lobby = Lobby(
                "robots", per_address=settings.unauthenticated_per_address, in_all=settings.unauthenticated
            )
            task_set = RobotTaskSet(
                hub,
                FormFactory(types),
                settings,
                name=name,
                machine=info,
                url=url,
                address=address,
                lobby=lobby,
                pool=pool,
            )
            scheme = "wss" if for_task_sets else "ws"
            channel = TaskSetChannel(
                Masters(f"{scheme}://{in_url(host)}:{port}" for host, port in self._places),
                self.secret,
                task_set.hello,
                task_set.handle,
                tls=for_task_sets.client if for_task_sets else None,
            )
            task_set.use(channel)
            door: Door = ClientDoor(settings, listener, lobby, for_robots.server if for_robots else None)
            async with asyncio.TaskGroup() as tasks:
                connected = tasks.create_task(channel.run())
                running: list[asyncio.Task[None]] = []
                async with door.opened(task_set):
                    running.append(tasks.create_task(task_set.run()))
                    running.append(tasks.create_task(_announce(channel, url, ready)))
                    try:
                        yield
                    finally:
                        # Before the robots leave: the master must not send them here again.
                        connected.cancel()
                        await asyncio.wait([connected])
                for task in reversed(running):
                    task.cancel()
        finally:
            await pool.close()
            await hub.close()


def _warn(text: str | None) -> None:
    if text is not None:
        _log.warning("%s", text)


def _package_index(given: Sequence[Path]) -> PackageIndex:
    """Return the packages on the given path, then on the environment's, then the shipped ones."""
    path = [*given, *PackageIndex.from_environ().path]
    with contextlib.suppress(ShippedFileError):
        path.append(examples_dir())
    return PackageIndex(path)


async def _announce(channel: TaskSetChannel, url: str, ready: Callable[[str], None]) -> None:
    """Report that robots can connect, once the master knows where to send them."""
    await channel.wait_connected()
    ready(url)


async def _listen(
    hub: LinkHub, machine: str, name: str, reach: str, settings: RobotSettings, *, tls: bool
) -> LinkAddress:
    """Accept links on a unix socket and on TCP; return the addresses."""
    remove_stale_sockets(run_dir(), "robot_*.sock")
    path = run_dir() / socket_name(name)
    await hub.listen_unix(path)
    with listening(settings.host, settings.link_port, "--link-port (rce up: --robot-link-port)"):
        listen = hub.listen_secure if tls else hub.listen_tcp
        port = await listen_on(listen, settings.host, settings.link_port)
    return LinkAddress(machine=machine, unix=str(path), host=reach, port=port, tls=tls)


async def _bind(host: str, port: int) -> socket.socket:
    """Bind the WebSocket port, so that its number is known before the first message to the master."""
    infos = await LOOKUPS.addresses(host or None, port, flags=socket.AI_PASSIVE)
    family, _, _, _, address = infos[0]
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except BaseException:
        listener.close()
        raise
    listener.setblocking(False)
    return listener
