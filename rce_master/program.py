"""Runs ``rce-master`` with settings that have been read."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import socket
import sys

import uvloop

from rce.aio.tasks import errors_in
from rce.config import (
    EngineSettings,
    EtcdAddress,
    LogFileError,
    RunDirError,
    Secret,
    SecretError,
    load_secret,
    log_as,
    read_store_address,
)
from rce.own_process import EndSignals, raise_file_limit
from rce.tls import CertificateError
from rce.tls.choice import TlsChoice
from rce_master.exceptions import MasterError
from rce_master.master import Master, RunningMaster
from rce_master.quotas import QuotaSettings
from rce_master.settings import MasterSettings, state_settings
from rce_master.store import SqliteStore

_log = logging.getLogger(__name__)


def run(engine: EngineSettings, *, verbose: bool = False) -> int:
    """Run a master until it is told to end.

    Args:
        engine: The settings.
        verbose: Log all messages.

    Returns:
        The exit code; faults were printed.
    """
    faults: tuple[BaseException, ...] = ()
    try:
        log_as("rce-master", engine, verbose=verbose)
        raise_file_limit()
        secret = load_secret(engine.secret_file, dev=engine.dev)
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(_run(_settings(engine), secret))
    except* (LogFileError, MasterError, SecretError, RunDirError, CertificateError) as group:
        faults = tuple(errors_in(group))
    for fault in faults:
        print(f"rce-master: {fault}", file=sys.stderr)  # noqa: T201 - for the user
    return 1 if faults else 0


def _settings(engine: EngineSettings) -> MasterSettings:
    """Derive the master's settings from the engine's."""
    own = engine.master
    address = read_store_address(own.store)
    machine = engine.machine or socket.gethostname()
    return MasterSettings(
        bind=own.bind,
        http_port=own.http_port,
        control_port=own.control_port,
        state_dir=engine.master_state,
        etcd=address if isinstance(address, EtcdAddress) else None,
        lease=own.lease,
        advertise=own.advertise,
        name=f"{machine}:{own.http_port}",
        dev=engine.dev,
        tls=TlsChoice.of(engine),
        allowed_origins=own.origins,
        public_names=own.public_names,
        trusted_proxies=own.trusted_proxies,
        token_lifetime=own.token_lifetime,
        quotas=QuotaSettings(
            requests=own.requests_per_second,
            request_burst=own.request_burst,
            streams=own.max_streams,
            log_reads=own.max_log_reads,
        ),
        state=state_settings(engine),
    )


async def _run(settings: MasterSettings, secret: Secret) -> None:
    """Run until SIGINT or SIGTERM."""
    if text := settings.tls.plain_warning("passwords travel", settings.bind):
        _log.warning("%s", text)
    task = asyncio.current_task()
    assert task is not None
    signals = EndSignals(task)
    signals.handle()
    if settings.etcd is not None:
        from rce_master.replicated import ReplicatedMaster  # loads aiohttp's client

        with contextlib.suppress(asyncio.CancelledError):
            await ReplicatedMaster(settings, secret).run(_announce, _announce_standby, lambda: signals.came)
        return
    store = await SqliteStore.open(settings.state_dir)
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await Master(settings, secret, store).run(_announce)
    finally:
        await store.close()


def _announce(master: RunningMaster) -> None:
    # The present objects stay; with a large state, each garbage collection of them would take half a second.
    gc.collect()
    gc.freeze()
    print(f"rce-master ready: {master.url}", flush=True)  # noqa: T201 - read by other programs


def _announce_standby(url: str) -> None:
    print(f"rce-master stand-by: {url}", flush=True)  # noqa: T201 - read by other programs
