"""A container with a volume in the master's state, and machines between which it moves."""

from __future__ import annotations

from typing import Any

from rce.control import SNAPSHOTS, EndpointStatus
from rce.model import MEGABYTE, Network, Volume
from rce_master.state import commands
from rce_master.state.core import State
from rce_master.state.lifecycle import VolumeMovePhase
from rce_master.state.settings import StateSettings
from rce_master.state.volume_moves import phase_began
from rce_master.state.volume_records import UserVolume
from support.master_world import World

SIZE = 64 * MEGABYTE
JOURNAL = Volume(name="journal", path="/data", size=SIZE)
KEPT = Volume(name="journal", path="/data", size=SIZE, snapshots=60)
OLD, NEW = "a" * 64, "b" * 64


class Moving(World):
    """Two machines or more; container ``c`` with a volume runs at ``c1``."""

    def __init__(
        self, volume: Volume = JOURNAL, options: StateSettings | None = None, *, group: str = ""
    ) -> None:
        super().__init__(options)
        self.machine("c1")
        network = Network.GROUP if group else Network.NONE
        self.container("c", volumes=(volume,), network=network, group=group)
        self.run("c", "c1")
        self.machine("c2")

    def machine(self, process: str, *running: EndpointStatus, snapshots: bool = True) -> None:
        self.container_set(
            process,
            running,
            name=f"m{process[1:]}",
            slots=4,
            volumes="image",
            networks=("none", "group"),
            features=(SNAPSHOTS,) if snapshots else (),
        )

    @property
    def volume(self) -> UserVolume:
        return self.state.tables.volumes["anna/journal"]

    @property
    def place(self) -> str:
        return self.state.tables.endpoints["anna/c"].task_set

    def phase_of_move(self) -> VolumeMovePhase | None:
        move = self.state.tables.volume_moves.get("anna/c")
        return None if move is None else move.phase

    @property
    def stays(self) -> str:
        return self.state.tables.container_live("anna/c").stays

    def orders(self, process: str) -> list[Any]:
        return self.state.orders(process)

    def move(self, machine: str = "m2") -> Any:
        return self.do(commands.MoveContainer(user="anna", tag="c", machine=machine))

    def gone(self, process: str = "c1") -> None:
        self.do(commands.EndpointGone(process=process, id="anna/c"))

    def saved(
        self,
        snapshot: str = NEW,
        *,
        error: str = "",
        is_last: bool = True,
        process: str = "",
        since: float | None = None,
    ) -> None:
        """A snapshot is accepted; it was reported now, or in the phase that began ``since``."""
        command = commands.SnapshotTaken(
            process=process or self.volume.process,
            volume="anna/journal",
            placement=self.volume.placement,
            is_last=is_last,
            snapshot="" if error else snapshot,
            size=7,
            taken=5.0,
            since=phase_began(self.state.tables, "anna/journal") if since is None else since,
            error=error,
        )
        self.do(command)

    def restored(self, process: str = "c2", *, error: str = "") -> None:
        number = self.volume.placement + 1
        self.do(
            commands.VolumeRestored(process=process, volume="anna/journal", placement=number, error=error)
        )

    def up_to(self, phase: VolumeMovePhase) -> None:
        """Bring the move of a container to a phase."""
        self.move()
        if phase is not VolumeMovePhase.STOPPING:
            self.gone()
        if phase is VolumeMovePhase.RESTORING:
            self.saved()
        assert self.phase_of_move() is phase

    def restart_master(self) -> None:
        tables = [table for table in self.state.tables.all if table.persistent]
        rows = {table.name: {table.key(record): table.encode(record) for record in table} for table in tables}
        self.state = State.load(rows, self.now, self.state.settings)
        self.state.validate()

    def removals(self) -> set[str]:
        return {removal.process for removal in self.state.tables.volume_removals}

    def runs_at(self, process: str) -> bool:
        """Whether a task set is told to run the container."""
        return self.place == process and not self.state.is_held("anna/c")
