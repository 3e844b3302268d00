"""Answers robots' logins and requests."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, assert_never

from rce.control import (
    ClientReply,
    ClientRequest,
    Fault,
    Gone,
    Hello,
    Left,
    LogChunk,
    Login,
    LoginReply,
    PatchStatus,
    PeerRefusedError,
    RequestFault,
    SpecWanted,
    StateSaved,
    Status,
    ToMaster,
    Usage,
    VolumeRemoved,
    VolumeRestored,
    VolumeSaved,
)
from rce.model import FaultCode
from rce_master import requests
from rce_master.audit import DONE, REFUSED, AuditLog, describe
from rce_master.exceptions import (
    FencedError,
    ForbiddenError,
    MasterError,
    NotFoundError,
    RefusedError,
    SaveTooLargeError,
    StoreError,
    TooManyFailuresError,
    TooManyLoginsError,
    TooMuchError,
    WrongCredentialsError,
)
from rce_master.quotas import Quotas
from rce_master.state import commands
from rce_master.state.lifecycle import RobotSession
from rce_master.state.robots import DRAINED, why_locked_out
from rce_master.tokens import Tokens

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rce_master.auth import Authenticator
    from rce_master.leadership import Fence
    from rce_master.reconciler import Peer, Reconciler
    from rce_master.snapshots.service import SnapshotService
    from rce_master.state_service import Outcome, StateService

_log = logging.getLogger(__name__)

MAX_PENDING = 1000
"""Concurrent requests; beyond it, their channels wait."""
MAX_TOGETHER = 200
"""Commands of one request that are done in one batch; other requests run between the batches."""
MAX_LOGINS = 4096
"""Concurrent logins; beyond it robots are told to try later. A delayed login blocks no other work."""

AGAIN_S = 1.0
"""After which a robot may try to log in again, where nothing else is known."""

MAX_TERMS_AHEAD = 1_000_000
"""A task set that has seen a term so far ahead is not believed: terms must not run out."""

_REMOVALS = (
    commands.DestroyContainer,
    commands.RemoveNode,
    commands.RemoveInterface,
    commands.DeleteParameter,
    commands.Disconnect,
)

_UNAUTHORIZED, _FORBIDDEN, _CONFLICT, _TOO_MANY, _UNAVAILABLE = 401, 403, 409, 429, 503


@dataclass(eq=False, slots=True)
class _PendingLogin:
    """A login in progress."""

    process: str
    id: str
    left: bool = False
    """Whether the robot left meanwhile."""


class ControlHandler:
    """Handles the messages of task sets: passes reports to the reconciler, and answers questions.

    Reports and requests are taken in the order of arrival; answers wait for the store without delaying later
    messages.
    """

    def __init__(
        self,
        state_service: StateService,
        reconciler: Reconciler,
        authenticator: Authenticator,
        tokens: Tokens | None = None,
        quotas: Quotas | None = None,
        audit: AuditLog | None = None,
        fence: Fence | None = None,
        snapshots: SnapshotService | None = None,
    ) -> None:
        self._snapshots = snapshots
        self._audit = audit
        self._fence = fence
        self._tokens = Tokens(state_service.tables) if tokens is None else tokens
        self._state_service = state_service
        self._reconciler = reconciler
        self._authenticator = authenticator
        self._quotas = quotas or Quotas()
        self._pending = asyncio.Semaphore(MAX_PENDING)
        self._group = asyncio.TaskGroup()
        self._logins: set[_PendingLogin] = set()

    async def run(self) -> None:
        """Answer until cancelled."""
        async with self._group:
            await asyncio.Event().wait()

    async def on_hello(self, peer: Peer, hello: Hello) -> None:
        """Handle a task set that connected.

        Raises:
            PeerRefusedError: It has seen a newer term of leadership.
        """
        if self._fence is not None:
            _check_term(self._fence, hello.term)
        await self._reconciler.on_hello(peer, hello)

    async def on_gone(self, peer: Peer) -> None:
        """Note that a task set's channel ended."""
        await self._reconciler.on_gone(peer)

    async def on_message(self, peer: Peer, message: ToMaster) -> None:
        """Handle a message of a task set."""
        process = peer.process
        match message:
            case Login():
                self._take_login(peer, message)
            case ClientRequest():
                await self._request(peer, message)
            case VolumeSaved():
                if self._snapshots is not None:
                    await self._spawn(self._snapshots.accept(process, message))
            case (
                Status()
                | PatchStatus()
                | SpecWanted()
                | Gone()
                | Fault()
                | Usage()
                | VolumeRemoved()
                | VolumeRestored()
                | Left()
                | Hello()
                | LogChunk()
                | StateSaved()
            ):
                self._note_leaving(process, message)
                await self._reconciler.on_message(process, message)
            case _:
                assert_never(message)

    async def _spawn(self, work: Coroutine[None, None, None]) -> None:
        await self._pending.acquire()
        task = self._group.create_task(self._guard(work))
        task.add_done_callback(lambda _: self._pending.release())

    async def _guard(self, work: Coroutine[None, None, None]) -> None:
        try:
            await work
        except Exception:  # noqa: BLE001 - logged
            # A bug in one answer; its asker runs into a timeout, all others continue.
            _log.exception("could not answer")

    # Logins

    def _take_login(self, peer: Peer, login: Login) -> None:
        if len(self._logins) >= MAX_LOGINS:
            reason = str(TooManyLoginsError())
            peer.send(
                LoginReply(request=login.request, status=_UNAVAILABLE, reason=reason, retry_after=AGAIN_S)
            )
            return
        pending_login = _PendingLogin(peer.process, f"{login.user}/{login.robot}")
        self._logins.add(pending_login)
        self._group.create_task(self._guard(self._login(peer, login, pending_login)))

    async def _login(self, peer: Peer, login: Login, pending_login: _PendingLogin) -> None:
        try:
            reply = await self._answer_login(pending_login.process, pending_login.id, login)
        finally:
            self._logins.discard(pending_login)
        peer.send(reply)
        if pending_login.left and reply.endpoint is not None:
            gone = commands.RobotLeft(
                process=pending_login.process, id=pending_login.id, reason="it left while it logged in"
            )
            await self._state_service.enqueue([gone])

    async def _answer_login(self, process: str, id_: str, login: Login) -> LoginReply:
        reply = await self._try_login(process, id_, login)
        if self._audit is not None:
            user = login.user if login.user in self._state_service.tables.users else ""
            if reply.endpoint is not None:
                by = "its own token" if login.token else "the password"
                self._audit.add(user, "connect_robot", id_, detail=f"by {by}", address=login.address)
            elif reply.status in (_UNAUTHORIZED, _FORBIDDEN, _TOO_MANY):
                detail = f"{reply.status} {login.robot if user else ''}".rstrip()
                self._audit.refuse(user, "connect_robot", detail=detail, address=login.address)
        return reply

    async def _try_login(self, process: str, id_: str, login: Login) -> LoginReply:
        if process in self._state_service.tables.drains:
            return LoginReply(request=login.request, status=_UNAVAILABLE, reason=DRAINED)
        retry_after = 0.0
        try:
            command = await self._admission(process, id_, login)
            await self._state_service.submit(command)
            if self._is_admitted(command):
                return LoginReply(request=login.request, endpoint=self._state_service.spec(id_))
            status, reason = _UNAVAILABLE, "the robot was sent away while it logged in; connect again"
            retry_after = AGAIN_S
        except WrongCredentialsError as error:
            status, reason = _UNAUTHORIZED, str(error)
        except (TooManyFailuresError, TooMuchError) as error:
            status, reason, retry_after = _TOO_MANY, str(error), error.retry_after
        except ForbiddenError as error:
            status, reason = _FORBIDDEN, str(error)
        except RefusedError as error:
            status, reason = _CONFLICT, str(error)
            self._probe_previous(process, id_)
        except MasterError as error:
            status, reason, retry_after = _UNAVAILABLE, str(error), AGAIN_S
        return LoginReply(request=login.request, status=status, reason=reason, retry_after=retry_after)

    def _is_admitted(self, command: commands.RobotLogin) -> bool:
        """Tell whether a login still holds: another command of its batch may have ended it."""
        tables = self._state_service.tables
        robot = tables.robot(command.id)
        return (
            robot is not None
            and (robot.task_set, robot.credential) == (command.process, command.credential)
            and tables.robot_live(command.id).session is RobotSession.CONNECTED
            and not why_locked_out(tables, robot)
        )

    async def _admission(self, process: str, id_: str, login: Login) -> commands.RobotLogin:
        """Check a robot's credentials; return the command that admits it.

        Raises:
            AuthError: The credentials are wrong, or cannot be checked now.
            TooMuchError: The user's robots log in too often.
            ForbiddenError: The credentials are correct, but not for this robot or purpose.
        """
        if not login.token:
            user = await self._authenticator.verify(login.user, login.password, login.address)
            self._quotas.robot_login(user)
            return commands.RobotLogin(process=process, id=id_, password=user.password)
        user, token = self._tokens.find(login.token)
        if not token.robot:
            raise ForbiddenError("this token is not for robots; make one for this robot: rce robot add ROBOT")
        if (user.name, token.robot) != (login.user, login.robot):
            raise ForbiddenError(
                "this token is good for another robot; make one for this: rce robot add ROBOT"
            )
        self._quotas.robot_login(user)
        return commands.RobotLogin(process=process, id=id_, credential=token.digest)

    def _probe_previous(self, process: str, id_: str) -> None:
        """Probe the former connection of a robot that logs in while it is connected at another task set.

        The former connection may be dead but not yet detected. The probe frees the robot's place for its next
        attempt, before the WebSocket's own pings time out.
        """
        robot = self._state_service.tables.robot(id_)
        if robot is not None and robot.task_set != process:
            self._reconciler.probe(id_)

    def _note_leaving(self, process: str, message: ToMaster) -> None:
        """Note a robot that left before its login is done: its session must not stay connected."""
        if not isinstance(message, Left):
            return
        for pending_login in self._logins:
            if (pending_login.process, pending_login.id) == (process, message.id):
                pending_login.left = True

    # Requests

    async def _request(self, peer: Peer, request: ClientRequest) -> None:
        user = request.id.partition("/")[0]
        robot = self._state_service.tables.robot(request.id)
        if robot is None:
            error = f"robot {request.id!r} is not known any more; connect again"
            peer.send(ClientReply(request=request.request, errors=(error,)))
            return
        if reason := why_locked_out(self._state_service.tables, robot):
            peer.send(ClientReply(request=request.request, errors=(reason,)))
            return
        try:
            self._quotas.robot_request(self._state_service.tables.users[user], requests.count_items(request))
        except TooMuchError as error:
            fault = RequestFault(code=error.code.value)
            peer.send(
                ClientReply(request=request.request, errors=(f"{request.type}: {error}",), faults=(fault,))
            )
            return
        wanted, faults = requests.read(user, request)
        parts = [wanted[first : first + MAX_TOGETHER] for first in range(0, len(wanted), MAX_TOGETHER)]
        outcomes = [await self._state_service.enqueue(part) for part in parts]
        await self._spawn(self._answer(peer, request, wanted, outcomes, faults))

    async def _answer(
        self,
        peer: Peer,
        request: ClientRequest,
        wanted: list[commands.Request],
        outcomes: list[asyncio.Future[list[Outcome]]],
        faults: list[str],
    ) -> None:
        found = [error for part in outcomes for error in await part]
        done: list[commands.Request] = []
        refused: list[tuple[commands.Request, MasterError]] = []
        for one, error in zip(wanted, found, strict=True):
            if error is None or (request.repeated and _was_removed(one, error)):
                done.append(one)
            else:
                refused.append((one, error))
        self._record(request, done, DONE)
        self._record(request, [one for one, _ in refused], REFUSED)
        reply = ClientReply(
            request=request.request,
            errors=(*faults, *(f"{request.type}: {error}" for _, error in refused)),
            faults=(*(RequestFault() for _ in faults), *(_fault_of(one, error) for one, error in refused)),
        )
        peer.send(reply)

    def _record(self, request: ClientRequest, parts: list[commands.Request], outcome: str) -> None:
        if self._audit is not None and parts:
            user, action = request.id.partition("/")[0], f"request_{request.type.lower()}"
            self._audit.add(user, action, detail=describe(parts), via=request.id, outcome=outcome)


def _was_removed(command: commands.Request, error: MasterError) -> bool:
    """Whether a removal was refused because what it removes is not there."""
    return isinstance(command, _REMOVALS) and isinstance(error, NotFoundError)


def _fault_of(command: commands.Request, error: MasterError) -> RequestFault:
    code = ""
    if isinstance(error, RefusedError):
        code = error.code.value
    elif isinstance(error, StoreError) and not isinstance(error, SaveTooLargeError):
        code = FaultCode.BUSY.value  # this master ends, or its disk is full: a later attempt may succeed
    return RequestFault(code=code, ids=requests.ids_of(command))


def _check_term(fence: Fence, term: int) -> None:
    """Refuse a task set that has seen a newer term; this master steps down then.

    Raises:
        PeerRefusedError: It has.
    """
    if term > fence.term + MAX_TERMS_AHEAD:
        raise PeerRefusedError(
            f"this task set says that term {term} has begun, which is not believed in term {fence.term};"
            " remove the file term from its state folder"
        )
    try:
        fence.heed(term)
    except FencedError as error:
        raise PeerRefusedError(str(error)) from error
