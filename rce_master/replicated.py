"""One of several masters on one etcd: a stand-by until it takes the lead, the leader until it loses it."""

from __future__ import annotations

import asyncio
import gc
import logging
from contextlib import AsyncExitStack
from functools import partial
from typing import TYPE_CHECKING

from rce.aio.tasks import TaskScope, errors_in
from rce.config.store_address import ETCD_PORT
from rce.guard import TrustedProxies
from rce.link.address import in_url, is_any, own_address
from rce.own_process import listening
from rce.tls.choice import is_loopback
from rce.tls.expiry import watch_expiry
from rce.tls.names import CertificateNames
from rce.web.origin import ServerNames
from rce.web.server import HttpServer
from rce_master.audit import AUDIT
from rce_master.cluster.client import ClusterClient
from rce_master.cluster.member_advice import MemberAdvice
from rce_master.exceptions import FencedError, MasterError
from rce_master.follower import StateFollower
from rce_master.http.forwarded import ForwardingKey
from rce_master.http.probe import Probe
from rce_master.leadership import LeaseSettings
from rce_master.leadership.drains import MasterDrains
from rce_master.leadership.engine_mark import EngineMark
from rce_master.leadership.keeper import LeadershipKeeper
from rce_master.leadership.registry import MasterRegistry
from rce_master.leadership.request_key import RequestKey
from rce_master.leadership.standby_client import CONNECT_S, StandbyClient
from rce_master.master import Master
from rce_master.other_audits import OtherAudits
from rce_master.packages.contents import ARCHIVES, ARCHIVES_PATH, ContentStore
from rce_master.packages.copies import ArchiveCopies
from rce_master.packages.transfer import ArchiveClient
from rce_master.snapshots.service import SNAPSHOT, SNAPSHOTS, SNAPSHOTS_PATH
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.exceptions import QUORUM, EtcdAwayError, NoQuorumError
from rce_master.store.etcd.layout import prepare
from rce_master.store.lock import FolderLock

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aiohttp import ClientSession
    from argon2 import PasswordHasher

    from rce.config import Secret
    from rce.tls import Context
    from rce_master.http.forward import Forwarder
    from rce_master.master import RunningMaster
    from rce_master.settings import MasterSettings

_log = logging.getLogger(__name__)

START_S = 5.0
"""How long a member of etcd may take for an answer when this program starts."""
START_TIMEOUT_S = 20.0
"""How long this program waits at its start until enough members of etcd answer."""
_PAUSE_S = 0.5
_ATTEMPTS = 4
"""Requests to members of etcd, one after the other, in the time of a lease."""


class ReplicatedMaster:
    """Runs a master whose state is in etcd, beside others.

    Args:
        settings: Its settings, with the address of etcd.
        secret: The secret by which task sets authenticate.
        hasher: How passwords are hashed.
    """

    def __init__(
        self, settings: MasterSettings, secret: Secret, *, hasher: PasswordHasher | None = None
    ) -> None:
        self._settings = settings
        self._secret = secret
        self._hasher = hasher

    async def run(
        self,
        on_ready: Callable[[RunningMaster], None],
        on_standby: Callable[[str], None],
        is_stopping: Callable[[], bool] = lambda: False,
    ) -> None:
        """Run until cancelled; then the lead is given back, so that another master takes it at once.

        Args:
            on_ready: Called each time that this master leads and listens.
            on_standby: Called with the URL of the stand-by's server each time that it listens.
            is_stopping: Asked when this master has lost the lead: whether to end instead of standing by. A
                cancellation at that moment would interrupt the closing of what belonged to the term.

        Raises:
            StoreError: etcd cannot be used as it is; the text says why.
            StoreBusyError: Another master uses the state folder.
            MasterError: A port cannot be used, or another master has this one's name.
            CertificateError: A certificate cannot be used.
        """
        settings = self._settings
        address = settings.etcd
        assert address is not None
        identity = settings.tls.own_identity() if address.tls else None
        remote = [host for host in address.hosts if not is_loopback(host)]
        if remote and identity is None:
            _log.warning("the state travels in clear to etcd on %s: use etcds://", ", ".join(remote))
        lock = FolderLock(settings.state_dir)
        try:
            tls = None if identity is None else identity.client
            attempt = settings.lease / _ATTEMPTS
            async with ClusterClient(address.endpoints, tls=tls, attempt=attempt) as client:
                registry = MasterRegistry(client, address.prefix, settings.name)
                async with EtcdClient(address.endpoints, tls=tls, attempt=START_S) as patient:
                    await _prepare(patient, address.prefix)
                    await EngineMark(patient, address.prefix, self._secret).check()
                    async with self._session() as session:
                        await registry.check_name(patient, Probe(session, self._masters_tls()).answers)
                lease = LeaseSettings(ttl=settings.lease)
                keeper = LeadershipKeeper(client, address.prefix, settings.name, lease)
                advice = MemberAdvice(client)
                async with TaskScope() as tasks:
                    tasks.spawn(registry.run(), name="registry of masters")
                    tasks.spawn(advice.run(), name="members of etcd")
                    if identity is not None:
                        tasks.spawn(watch_expiry([identity.files]), name="certificate for etcd")
                    while not is_stopping():
                        await self._stand_by_and_lead(client, keeper, registry, advice, on_ready, on_standby)
        finally:
            lock.close()

    async def _stand_by_and_lead(
        self,
        etcd: EtcdClient,
        keeper: LeadershipKeeper,
        registry: MasterRegistry,
        advice: MemberAdvice,
        on_ready: Callable[[RunningMaster], None],
        on_standby: Callable[[str], None],
    ) -> None:
        from rce_master.http.archives import ArchiveRoutes  # loads aiohttp's server
        from rce_master.http.audit_route import AuditRoute
        from rce_master.http.leader_check import LeaderCheck
        from rce_master.http.standby import make_standby_app

        settings = self._settings
        for_clients = settings.tls.for_clients()
        names = ServerNames(settings.bind, settings.names, CertificateNames(for_clients))
        key = RequestKey(self._secret)
        check = LeaderCheck(key, keeper.newest_term)
        packages = ContentStore(settings.state_dir / ARCHIVES, noun="package")
        snapshots = ContentStore(settings.state_dir / SNAPSHOTS, noun=SNAPSHOT)
        for_leader = (
            ArchiveRoutes(packages, check, ARCHIVES_PATH),
            ArchiveRoutes(snapshots, check, SNAPSHOTS_PATH),
            AuditRoute(settings.state_dir / AUDIT, check),
        )
        assert settings.etcd is not None
        follower = StateFollower(etcd, settings.etcd.prefix, settings.state, asyncio.get_running_loop().time)
        async with AsyncExitStack() as waiting, self._session() as session:
            beside = await waiting.enter_async_context(TaskScope())
            beside.spawn(follower.run(), name="copy of the state")
            forwarder = await waiting.enter_async_context(self._forwarder())
            _tell_each_other(keeper, follower, forwarder)
            server = HttpServer(
                make_standby_app(
                    keeper,
                    follower,
                    forwarder,
                    for_leader,
                    names,
                    settings.allowed_origins,
                    (lambda: packages.fault, lambda: snapshots.fault),
                ),
                settings.bind,
                settings.http_port,
                for_clients.server if for_clients else None,
            )
            try:
                with listening(settings.bind, settings.http_port, "--http-port"):
                    await waiting.enter_async_context(server)
            except OSError as error:
                raise MasterError(str(error)) from error
            keeper.url = await self._own_url(server.url)
            registry.announce(keeper.url)
            on_standby(server.url)
            store, fence = await keeper.acquire()
            _log.info("this master leads in term %d", fence.term)
            tls = self._masters_tls()
            probe = Probe(session, tls)
            prefix = settings.etcd.prefix
            drains = MasterDrains(etcd, prefix, settings.name, registry, probe.stands_by)
            mark = EngineMark(etcd, prefix, self._secret)
            standbys = StandbyClient(session, key, fence, tls)

            def copies(contents: ContentStore, path: str, noun: str) -> ArchiveCopies:
                return ArchiveCopies(contents, registry, ArchiveClient(standbys, path), noun=noun)

            try:
                master = Master(
                    settings,
                    self._secret,
                    store,
                    hasher=self._hasher,
                    fence=fence,
                    copies=copies,
                    drains=drains,
                    audits=OtherAudits(registry, standbys),
                    copy=partial(follower.take, store.begun),
                    warnings=[lambda: advice.text],
                )
                async with asyncio.TaskGroup() as group:
                    works = (keeper.keep(), drains.run(), mark.run())
                    keeping = [group.create_task(work) for work in works]
                    await master.run(on_ready, waiting.aclose, partial(_hand_over, keeper, keeping))
            except* (FencedError, EtcdAwayError) as errors:
                _log.warning("this master leads no more: %s", next(errors_in(errors)))
            finally:
                await keeper.step_down()
                gc.unfreeze()

    def _forwarder(self) -> Forwarder:
        from rce_master.http.forward import Forwarder  # loads aiohttp

        key = ForwardingKey(self._secret)
        return Forwarder(key, TrustedProxies(self._settings.trusted_proxies), self._masters_tls())

    def _masters_tls(self) -> Context | None:
        """Return what gives the TLS context of a connection to another master; None: the library's own."""
        tls = self._settings.tls
        return tls.own_identity().client if tls.enabled and tls.certificate is None else None

    @staticmethod
    def _session() -> ClientSession:
        from aiohttp import ClientSession, ClientTimeout, DummyCookieJar

        timeout = ClientTimeout(total=None, sock_connect=CONNECT_S)  # each request has a limit of its own
        return ClientSession(cookie_jar=DummyCookieJar(), timeout=timeout, trust_env=False)

    async def _own_url(self, url: str) -> str:
        """Return the URL of this machine's HTTP server for the other masters.

        Args:
            url: The same for programs on this machine.
        """
        settings = self._settings
        assert settings.etcd is not None
        host = settings.advertise or settings.bind
        if is_any(host):
            others = [one for one in settings.etcd.hosts if not is_loopback(one)]
            host = await own_address((*others, *settings.etcd.hosts)[0], ETCD_PORT)
        scheme, port = url.partition("://")[0], url.rstrip("/").rpartition(":")[2]
        return f"{scheme}://{in_url(host)}:{port}/"


def _tell_each_other(keeper: LeadershipKeeper, follower: StateFollower, forwarder: Forwarder) -> None:
    keeper.on_save, keeper.on_look = follower.saw, forwarder.led_by
    keeper.is_watched = lambda: follower.is_watching
    follower.on_leadership = keeper.wake


def _hand_over(keeper: LeadershipKeeper, keeping: Sequence[asyncio.Task[None]]) -> None:
    for task in keeping:
        task.cancel()  # without a lease, they would report that it is lost
    keeper.resign()


async def _prepare(client: EtcdClient, prefix: str) -> None:
    """Prepare etcd, which may be starting at the same time as this program.

    Raises:
        StoreError: It cannot be used, or does not answer in time.
    """
    clock = asyncio.get_running_loop().time
    end = clock() + START_TIMEOUT_S
    level = logging.WARNING
    last: EtcdAwayError | NoQuorumError = NoQuorumError(
        f"etcd has no quorum, or needs more than {START_TIMEOUT_S:.3g} s for an answer: {QUORUM}"
    )
    try:
        async with asyncio.timeout_at(end):
            while True:
                try:
                    await prepare(client, prefix)
                except (EtcdAwayError, NoQuorumError) as error:
                    _log.log(level, "%s; trying again for %.0f s", error, end - clock())
                    level, last = logging.DEBUG, error
                else:
                    return
                await asyncio.sleep(_PAUSE_S)
    except TimeoutError:
        raise last from None
