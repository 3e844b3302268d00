"""Accepts packages that users push."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce.aio.tasks import finish
from rce.control import TaskSetKind
from rce.guard import CrowdedError, Turns
from rce.packages import BadKeyError, BadSignatureError, statement, verify
from rce_master.exceptions import BusyError, ForbiddenError, InvalidRequestError
from rce_master.packages.uploads import MAX_UPLOADS, Uploads
from rce_master.state import commands, packages
from rce_master.state.user_records import UserPackage, package_key_key, user_package_key

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rce.packages.contents import Contents
    from rce_master.packages.contents import Incoming
    from rce_master.packages.keeper import ContentKeeper
    from rce_master.state_service import StateService

INSPECTED_AT_ONCE = 2
"""Archives that are inspected at the same time, which takes processor time."""


_NOT_INSTALLED = (
    "requirements.txt: no machine of this engine installs what it asks for; its operator may allow it by:"
    " rce-container --allow-requirements"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PushRequest:
    """A request to accept a version."""

    user: str
    name: str
    version: str
    key: str
    """The public key of the signature, in hex."""
    signature: str
    """In hex, over :func:`rce.packages.signing.statement`."""


class PackageService:
    """Accepts packages.

    Args:
        state_service: Knows the versions and the keys.
        keeper: Keeps their contents.
        clock: Seconds since 1970.
    """

    def __init__(
        self,
        state_service: StateService,
        keeper: ContentKeeper,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._state_service = state_service
        self._keeper = keeper
        self._clock = clock
        self._uploads = Uploads()
        self._turns = Turns(INSPECTED_AT_ONCE, waiting=MAX_UPLOADS)

    async def push(
        self, request: PushRequest, size: int, chunks: AsyncIterator[bytes]
    ) -> tuple[UserPackage, tuple[str, ...]]:
        """Accept a version of a package.

        Args:
            request: The version.
            size: Bytes of the archive, from the sender; 0 if unknown.
            chunks: The archive.

        Returns:
            The stored version, and notes for its owner.

        Raises:
            Refused: It cannot be accepted.
            StoreError: It cannot be stored.
        """
        self._check_early(request, size)
        async with self._uploads.one(request.user) as upload:
            package, contents, warning = await self._take(request, upload.counted(chunks))
        kept = self._state_service.tables.packages.get(package.id) or package
        return kept, (*contents.warnings, *self._warnings(contents), *filter(None, [warning]))

    async def _take(
        self, request: PushRequest, chunks: AsyncIterator[bytes]
    ) -> tuple[UserPackage, Contents, str]:
        """Accept an archive; return the version, what is in it, and a warning for its owner or nothing."""
        async with self._keeper.store.receive(chunks) as incoming:
            _verify(request, incoming)
            contents = await self._inspect(request.user, incoming)
            package = self._package(request, incoming, contents)
            packages.check_new(self._state_service.tables, package)
            async with self._keeper.keep(incoming) as warning:
                # To its end: contents that the state is about to name must not be removed.
                await finish(self._state_service.submit(commands.AddPackage(package=package)))
        return package, contents, warning

    async def _inspect(self, user: str, incoming: Incoming) -> Contents:
        try:
            async with self._turns.turn(user):
                return await incoming.inspect()
        except CrowdedError:
            raise BusyError("too many packages are pushed at the same time; try again in a moment") from None

    def _check_early(self, request: PushRequest, size: int) -> None:
        """Refuse an invalid version before its archive has been received."""
        tables, settings = self._state_service.tables, self._state_service.state.settings
        if package_key_key(request.user, request.key) not in tables.package_keys:
            raise ForbiddenError("the key is not registered with your account; run: rce package key register")
        if user_package_key(request.user, request.name, request.version) not in tables.packages:
            packages.check_room(tables, settings, request.user, size)

    def _package(self, request: PushRequest, incoming: Incoming, contents: Contents) -> UserPackage:
        if contents.name != request.name:
            raise InvalidRequestError(
                f"the archive holds the package {contents.name!r}, not {request.name!r}"
            )
        return UserPackage(
            user=request.user,
            name=request.name,
            version=request.version,
            sha256=incoming.sha256,
            digest=contents.digest,
            signature=request.signature,
            key=request.key,
            packed=incoming.size,
            size=contents.size,
            files=contents.files,
            created=self._clock(),
            description=contents.description,
            executables=contents.executables,
            requirements=contents.requirements,
        )

    def _warnings(self, contents: Contents) -> tuple[str, ...]:
        if not contents.requirements:
            return ()
        tables = self._state_service.tables
        if any(
            task_set.machine.requirements
            for task_set in tables.task_sets
            if task_set.kind is TaskSetKind.CONTAINER and tables.is_connected(task_set.process)
        ):
            return ()
        return (_NOT_INSTALLED,)


def _verify(request: PushRequest, incoming: Incoming) -> None:
    signed = statement(request.user, request.name, request.version, incoming.sha256)
    try:
        verify(request.key, request.signature, signed)
    except (BadKeyError, BadSignatureError) as error:
        raise InvalidRequestError(
            f"{error}; the package was changed on its way, or signed for another user or version"
        ) from error
