"""The Master Task Set, put together from its parts."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from rce.control import NODE_STATES, PATCHES, SNAPSHOTS, TYPED_REQUESTS
from rce.control_channel.server import ControlServer
from rce.guard import TrustedProxies
from rce.own_process import listening
from rce.tls.expiry import watch_expiry
from rce.tls.names import CertificateNames
from rce.web.origin import ServerNames
from rce.web.server import HttpServer, LateApplication
from rce_master.answers import PURPOSE as ANSWERS_PURPOSE
from rce_master.answers import Answers
from rce_master.audit import AUDIT, AuditLog
from rce_master.auth import Authenticator, client_digest, hash_public
from rce_master.control_handler import ControlHandler
from rce_master.events import EventLog
from rce_master.exceptions import MasterError
from rce_master.executions import Executions
from rce_master.http.entry import Entry, refusal
from rce_master.http.forwarded import ForwardingKey
from rce_master.http.routes import Services
from rce_master.node_states import NodeStateServer
from rce_master.packages.contents import ARCHIVES, ARCHIVES_PATH, ContentStore
from rce_master.packages.keeper import CONTENT, ContentKeeper
from rce_master.packages.service import PackageService
from rce_master.quotas import Quotas
from rce_master.reconciler import Reconciler
from rce_master.snapshots.service import SNAPSHOT, SNAPSHOTS_PATH, SnapshotService
from rce_master.snapshots.service import SNAPSHOTS as SNAPSHOTS_FOLDER
from rce_master.state import commands
from rce_master.state.user_records import User, UserRole
from rce_master.state_service import StateService
from rce_master.tokens import Tokens

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from aiohttp import web
    from argon2 import PasswordHasher

    from rce.config import Secret
    from rce.web.entry import EntryAnswer
    from rce_master.leadership import Fence
    from rce_master.leadership.drains import MasterDrains
    from rce_master.other_audits import OtherAudits
    from rce_master.packages.copies import ArchiveCopies
    from rce_master.settings import MasterSettings
    from rce_master.state.changes import Changes
    from rce_master.state.core import State
    from rce_master.store import Store

_log = logging.getLogger(__name__)

TICK_S = 0.5
_ACCESS = ("users", "tokens")
"""Tables that determine permissions to follow events."""
DEV_USER = "testUser"
FENCED = "This master leads no more; ask again.\n"


@dataclass(frozen=True, slots=True)
class RunningMaster:
    """The addresses of a running master."""

    url: str
    """Of the HTTP server."""
    control_port: int
    state_service: StateService


@dataclass(frozen=True, slots=True)
class _TaskSetContents:
    """What task sets fetch and bring beside the control channel."""

    keeper: ContentKeeper
    snapshots: SnapshotService
    node_states: NodeStateServer

    async def read(self, sha256: str, offset: int, count: int) -> tuple[bytes, int] | None:
        """Read a piece of a content; None if it does not exist."""
        found = await self.keeper.read(sha256, offset, count)
        return found if found is not None else await self.snapshots.read(sha256, offset, count)


class Master:
    """Runs a master on a store.

    Args:
        settings: Its settings.
        secret: The secret by which task sets authenticate.
        store: Keeps the desired state; the caller closes it.
        hasher: How passwords are hashed.
        fence: Tells whether this master leads, if there may be others; the store is one of its term.
        copies: Makes what copies contents to the other masters, if there may be any: of a folder, where
            the others are asked for them, and what they are part of.
        drains: Of this master and the others, if there may be any; the caller runs them.
        audits: Those of the others, if there may be any.
        copy: As :meth:`rce_master.state_service.StateService.open` takes it.
        warnings: What ``/healthz`` tells beside what this master finds; empty texts are left out.
    """

    def __init__(
        self,
        settings: MasterSettings,
        secret: Secret,
        store: Store,
        *,
        hasher: PasswordHasher | None = None,
        fence: Fence | None = None,
        copies: Callable[[ContentStore, str, str], ArchiveCopies] | None = None,
        drains: MasterDrains | None = None,
        audits: OtherAudits | None = None,
        copy: Callable[[], Awaitable[State | None]] | None = None,
        warnings: Iterable[Callable[[], str]] = (),
    ) -> None:
        self._fence = fence
        self._copies = copies
        self._drains = drains
        self._audits = audits
        self._copy = copy
        self._warnings = tuple(warnings)
        self._settings = settings
        self._secret = secret
        self._store = store
        self._hasher = hasher

    async def run(
        self,
        on_ready: Callable[[RunningMaster], None],
        before_listening: Callable[[], Awaitable[None]] | None = None,
        hand_over: Callable[[], None] | None = None,
    ) -> None:
        """Run until cancelled.

        Args:
            on_ready: Called once everything listens.
            before_listening: Awaited after the state was loaded; frees the ports.
            hand_over: Called at the end, when the requests of HTTP clients have been answered: lets another
                master lead. What is left here is closed meanwhile, and acts no more.

        Raises:
            FencedError: This master leads no more.
            StoreError: The store cannot be read.
            MasterError: A port cannot be used.
            CertificateError: A certificate cannot be used.
        """
        state_service = await StateService.open(
            self._store, self._settings.state, fence=self._fence, copy=self._copy
        )
        if before_listening is not None:
            await before_listening()
        if not self._settings.dev and not len(state_service.tables.users):
            _log.warning(
                "there are no users, so no one can log in: stop this program and run"
                " `rce user add NAME --admin %s`",
                f"--state-dir {self._settings.state_dir}" if self._fence is None else "--store etcd://...",
            )
        term = 0 if self._fence is None else self._fence.term
        events = EventLog(time.time(), term=term)
        state_service.listeners.append(lambda changes: _log_events(events, changes))
        reconciler = Reconciler(state_service)
        authenticator = Authenticator(
            state_service.tables,
            hasher=self._hasher,
            keys=lambda: self._secret.derive_all("known logins"),
            remember=lambda login: state_service.enqueue([commands.RememberLogin(login=login)]),
        )
        tokens = Tokens(state_service.tables)
        quotas = Quotas(self._settings.quotas)
        audit = AuditLog(self._settings.state_dir / AUDIT, time.time, term=term)
        lifetime = self._settings.token_lifetime
        store = ContentStore(self._settings.state_dir / ARCHIVES, noun=CONTENT)
        copies = None if self._copies is None else self._copies(store, ARCHIVES_PATH, CONTENT)
        keeper = ContentKeeper(state_service, store, copies)
        packages = PackageService(state_service, keeper)
        node_states = NodeStateServer(state_service, keeper, reconciler, self._fence)
        kept = ContentStore(self._settings.state_dir / SNAPSHOTS_FOLDER, noun=SNAPSHOT)
        copies = None if self._copies is None else self._copies(kept, SNAPSHOTS_PATH, SNAPSHOT)
        snapshots = SnapshotService(state_service, kept, copies=copies, fence=self._fence)
        control_handler = ControlHandler(
            state_service, reconciler, authenticator, tokens, quotas, audit, self._fence, snapshots
        )
        services = Services(
            state_service=state_service,
            reconciler=reconciler,
            authenticator=authenticator,
            events=events,
            clock=time.time,
            token_lifetime=lifetime,
            packages=packages,
            tokens=tokens,
            proxies=TrustedProxies(self._settings.trusted_proxies),
            executions=Executions(),
            quotas=quotas,
            dev=self._settings.dev,
            audit=audit,
            answers=Answers(state_service.tables, self._secret.derive(ANSWERS_PURPOSE), time.time),
            fence=self._fence,
            forwarding=ForwardingKey(self._secret),
            drains=self._drains,
            other_audits=self._audits,
            warnings=(lambda: audit.fault, lambda: store.fault, lambda: kept.fault, *self._warnings),
        )
        try:
            async with asyncio.TaskGroup() as group:
                workers = [
                    group.create_task(work)
                    for work in (
                        state_service.run(),
                        control_handler.run(),
                        reconciler.run(),
                        keeper.run(),
                        snapshots.run(),
                        services.tokens.run(state_service),
                        services.answers.run(state_service),
                        _tick(state_service, audit),
                    )
                ]

                def resign() -> None:
                    if hand_over is not None:
                        for worker in workers:
                            worker.cancel()  # it would find that this master leads no more
                        hand_over()

                try:
                    contents = _TaskSetContents(keeper, snapshots, node_states)
                    await self._serve(services, control_handler, contents, on_ready, resign)
                finally:
                    # Last: task sets that leave while the servers close still need the state service.
                    for worker in workers:
                        worker.cancel()
        finally:
            authenticator.close()
            audit.close()

    async def _serve(
        self,
        services: Services,
        control_handler: ControlHandler,
        contents: _TaskSetContents,
        on_ready: Callable[[RunningMaster], None],
        resign: Callable[[], None],
    ) -> None:
        settings = self._settings
        if settings.dev:
            await make_dev_user(services)
        for_clients, for_task_sets = settings.tls.for_clients(), settings.tls.for_task_sets()
        names = ServerNames(settings.bind, settings.names, CertificateNames(for_clients))
        entry = Entry(
            services.state_service.tables, asyncio.get_running_loop().time, services.reconciler.silence
        )

        def load() -> Callable[[], web.Application]:
            from rce_master.http.server import make_app  # takes 12 MB, which robots do not need

            return partial(make_app, services, entry, allowed_origins=settings.allowed_origins, names=names)

        fence = self._fence
        app = LateApplication(load, entry.answer if fence is None else partial(_answer_fenced, fence, entry))
        control = ControlServer(
            self._secret,
            on_hello=control_handler.on_hello,
            on_message=control_handler.on_message,
            on_gone=control_handler.on_gone,
            master="rce-master",
            host=settings.bind,
            port=settings.control_port,
            contents=contents.read,
            tls=for_task_sets.mutual_server if for_task_sets else None,
            is_revoked=for_task_sets.is_revoked if for_task_sets else None,
            on_execution=services.executions.arrived,
            on_upload=contents.snapshots.take,
            on_node_state=contents.node_states.serve,
            features=(PATCHES, TYPED_REQUESTS, SNAPSHOTS, NODE_STATES),
            is_fenced=None if fence is None else lambda: fence.is_closed,
            term=0 if fence is None else fence.term,
        )
        http = HttpServer(app, settings.bind, settings.http_port, for_clients.server if for_clients else None)
        async with AsyncExitStack() as stack:
            try:
                with listening(settings.bind, settings.control_port, "--control-port"):
                    await stack.enter_async_context(control)
                # After requests that can be finished, before task sets are waited for, which may be silent.
                stack.callback(resign)
                with listening(settings.bind, settings.http_port, "--http-port"):
                    await stack.enter_async_context(http)
            except OSError as error:
                raise MasterError(str(error)) from error
            on_ready(RunningMaster(http.url, control.port, services.state_service))
            await watch_expiry([one.files for one in (for_clients, for_task_sets) if one is not None])


async def make_dev_user(services: Services) -> None:
    """Make the user of development mode, if it does not exist."""
    if DEV_USER in services.state_service.tables.users:
        return
    user = User(
        name=DEV_USER,
        role=UserRole.ADMIN,
        password=hash_public(client_digest(DEV_USER)),
        created=services.clock(),
    )
    await services.state_service.submit(commands.AddUser(user=user))


def _answer_fenced(fence: Fence, entry: Entry, query: str) -> EntryAnswer:
    return refusal(FENCED) if fence.is_closed else entry.answer(query)


async def _tick(state_service: StateService, audit: AuditLog) -> None:
    while True:
        await asyncio.sleep(TICK_S)
        audit.flush()
        (outcome,) = await state_service.submit_all([commands.Tick()])
        if outcome is not None:
            _log.error("grace times were not looked at: %s", outcome)


def _log_events(events: EventLog, changes: Changes) -> None:
    now = time.time()
    if any(table in _ACCESS for table, _ in changes.written()):
        events.wake()
    for state_event in changes.events:
        events.add(state_event, now)
        _log.info("%s %s %s", state_event.kind, state_event.subject, state_event.text)
