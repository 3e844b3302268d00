"""The state: applies commands one after the other, each atomically."""

from __future__ import annotations

import contextlib
import gc
import secrets
from typing import TYPE_CHECKING, Any

import msgspec

from rce_master.exceptions import StoreError
from rce_master.state import (
    answers,
    commands,
    containers,
    draining,
    limits,
    packages,
    placing,
    resizing,
    robots,
    saved_states,
    task_sets,
    tokens,
    users,
    volume_moves,
    volumes,
    wiring,
)
from rce_master.state.changes import Changes, Touched, Transaction
from rce_master.state.invariants import validate
from rce_master.state.migration import converted
from rce_master.state.settings import StateSettings
from rce_master.state.specs import build_copy_spec, build_patch, build_spec
from rce_master.state.tables import Tables

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rce.control import EndpointSpec, SpecPatch, ToTaskSet
    from rce_master.store.base import Snapshot

_HANDLERS: dict[type, Callable[[Transaction, Any], None]] = {
    commands.AddUser: users.add_user,
    commands.SetPassword: users.set_password,
    commands.SetRole: users.set_role,
    commands.RemoveUser: users.remove_user,
    commands.SetLimits: limits.set_limits,
    commands.RememberLogin: users.remember_login,
    commands.ForgetAnswers: answers.forget_old,
    commands.AddToken: tokens.add,
    commands.RemoveToken: tokens.remove,
    commands.NoteTokenUses: tokens.note_uses,
    commands.RevokeToken: tokens.revoke,
    commands.RevokeRobotToken: tokens.revoke_robot,
    commands.AddPackageKey: packages.add_key,
    commands.RemovePackageKey: packages.remove_key,
    commands.AddPackage: packages.add_package,
    commands.RemovePackage: packages.remove_package,
    commands.RemoveVolume: volumes.remove,
    commands.SnapshotTaken: volume_moves.snapshot_taken,
    commands.SnapshotLost: volumes.forget_snapshot,
    commands.SaveState: saved_states.save,
    commands.RemoveState: saved_states.remove,
    commands.TaskSetArrived: task_sets.arrived,
    commands.RobotsFound: task_sets.robots_found,
    commands.TaskSetLeft: task_sets.left,
    commands.StatusReported: task_sets.status_reported,
    commands.StatusPatched: task_sets.status_patched,
    commands.SpecRequested: task_sets.spec_requested,
    commands.EndpointGone: task_sets.gone,
    commands.FaultReported: task_sets.fault,
    commands.RobotLogin: robots.login,
    commands.RobotLeft: robots.left,
    commands.Continue: task_sets.continue_work,
    commands.Tick: task_sets.tick,
    commands.SetDraining: draining.set_draining,
    commands.MoveContainer: draining.move_container,
    commands.ResizeContainer: resizing.resize_container,
    commands.DestroyContainer: containers.destroy_container,
    commands.AddNode: containers.add_node,
    commands.RemoveNode: containers.remove_node,
    commands.SetParameter: containers.set_parameter,
    commands.DeleteParameter: containers.delete_parameter,
    commands.AddInterface: wiring.add_interface,
    commands.RemoveInterface: wiring.remove_interface,
    commands.Connect: wiring.connect,
    commands.Disconnect: wiring.disconnect,
}


def _create_and_place(tx: Transaction, command: commands.CreateContainer) -> None:
    containers.create_container(tx, command)
    placing.place_waiting(tx)


def _remove_and_place(tx: Transaction, command: commands.VolumeRemoved) -> None:
    volumes.removed(tx, command)
    placing.place_waiting(tx)


def _restored_and_advance(tx: Transaction, command: commands.VolumeRestored) -> None:
    volume_moves.restored(tx, command)
    draining.advance(tx)


_HANDLERS[commands.VolumeRestored] = _restored_and_advance


def _do_once(tx: Transaction, command: commands.Once) -> None:
    _HANDLERS[type(command.command)](tx, command.command)
    answers.keep(tx, command.answer)


_HANDLERS[commands.Once] = _do_once
_HANDLERS[commands.CreateContainer] = _create_and_place
_HANDLERS[commands.VolumeRemoved] = _remove_and_place


PIECE = 500
"""Rows that are read between two pauses: some milliseconds."""


def _new_token() -> str:
    return secrets.token_hex(24)


@contextlib.contextmanager
def without_collections() -> Iterator[None]:
    """Make many objects that stay: looking for garbage among them would take as long as making them."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class State:
    """Users, task sets, robots, containers and their wiring, desired and observed.

    No I/O, no clock, no task: the time comes with every command.

    Args:
        settings: Grace times and limits.
        make_token: Makes the secret of a link.
    """

    def __init__(
        self, settings: StateSettings | None = None, *, make_token: Callable[[], str] = _new_token
    ) -> None:
        self.tables = Tables()
        self.settings = settings or StateSettings()
        self._make_token = make_token
        self._by_name = {table.name: table for table in self.tables.all if table.persistent}

    @classmethod
    def load(
        cls, snapshot: Snapshot, now: float, settings: StateSettings | None = None, *, revision: int = 0
    ) -> State:
        """Load the state from the store.

        Args:
            snapshot: The contents of the store, of this release or the previous one; a store that is written
                to must be converted first (:func:`rce_master.state.migration.conversion`).
            now: Seconds of a clock that never goes back.
            settings: Limits and times.
            revision: Revisions continue above this, also if the store is an old copy. It must grow from one
                start of the master to the next more than there were changes between them: the time of day
                in milliseconds does.

        Raises:
            StoreError: A record cannot be read.
        """
        state = cls(settings)
        with without_collections():
            for _ in state.reading(snapshot):
                pass
            for _ in state.beginning(now, revision):
                pass
        return state

    def reading(self, snapshot: Snapshot, piece: int = PIECE) -> Iterator[None]:
        """Read the rows of the store, with a pause after each piece; :meth:`beginning` comes next.

        Args:
            snapshot: As for :meth:`load`.
            piece: Number of rows.

        Raises:
            StoreError: A record cannot be read.
        """
        try:
            snapshot = converted(snapshot)
            for table in self.tables.all:
                yield from table.reading(snapshot.get(table.name, {}), piece)
        except msgspec.MsgspecError as error:
            raise StoreError(f"a record in the store cannot be read: {error}") from error

    def write_row(self, table: str, key: str, body: bytes | None) -> bool:
        """Write a row as the store has it, before :meth:`beginning`; None removes it.

        Returns:
            Whether there is such a table.

        Raises:
            StoreError: The record cannot be read.
        """
        found = self._by_name.get(table)
        if found is None:
            return False
        try:
            found.write(key, body)
        except msgspec.MsgspecError as error:
            raise StoreError(f"a record in the store cannot be read: {error}") from error
        return True

    @property
    def rows(self) -> int:
        """The number of rows that the store has of it."""
        return sum(map(len, self._by_name.values()))

    def beginning(self, now: float, revision: int, piece: int = PIECE) -> Iterator[None]:
        """Begin to work with what was read, with a pause after each piece.

        Args:
            now: As for :meth:`load`.
            revision: As for :meth:`load`.
            piece: Number of endpoints.
        """
        yield from task_sets.restarting(self._begin(now), revision, piece)

    def apply(self, command: commands.Command, now: float, max_work: int | None = None) -> Changes:
        """Apply a command.

        Args:
            command: The command.
            now: Seconds of a clock that never goes back.
            max_work: In place of that of the settings.

        Returns:
            The changes and their effects.

        Raises:
            Refused: The state does not allow it; nothing changed.
        """
        tx = self._begin(now, max_work)
        try:
            _HANDLERS[type(command)](tx, command)
            return tx.seal()
        except BaseException:
            tx.changes.revert()
            raise

    def spec(self, endpoint: str) -> EndpointSpec:
        """Return the desired state of an endpoint.

        Raises:
            KeyError: There is no such endpoint.
        """
        return build_spec(self.tables, endpoint)

    def copy_spec(self, endpoint: str) -> tuple[str, EndpointSpec] | None:
        """Return the desired state of a container's copy at its next machine; None without a copy.

        Returns:
            The process name of the task set, and the spec to make.
        """
        move = self.tables.moves.get(endpoint)
        if move is None:
            return None
        return move.to, build_copy_spec(self.tables, endpoint)

    def is_held(self, endpoint: str) -> bool:
        """Return whether an endpoint is a container that is to run nowhere, since it moves with volumes."""
        return endpoint in self.tables.volume_moves

    def orders(self, process: str) -> list[ToTaskSet]:
        """Return what a task set has to do for containers that move with their volumes."""
        found = (volume_moves.orders(self.tables, move) for move in self.tables.volume_moves)
        return [message for one in found for to, message in one if to == process]

    def patch(self, endpoint: str, touched: Touched) -> SpecPatch:
        """Return the desired state of the changed parts of an endpoint.

        Raises:
            KeyError: There is no such endpoint.
        """
        return build_patch(self.tables, endpoint, touched)

    def validate(self) -> None:
        """Check all invariants.

        Raises:
            AssertionError: An invariant does not hold; the text says which.
        """
        validate(self.tables)

    def _begin(self, now: float, max_work: int | None = None) -> Transaction:
        return Transaction(self.tables, now, self.settings, self._make_token, max_work)
