"""Random histories: invariants hold, refusals change nothing, and the store always tells the same."""

from __future__ import annotations

from dataclasses import replace as replace_dataclass

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from msgspec.structs import replace

from rce.control.desired import DesiredState, Fit
from rce.control.messages import CONTROL_VERSION, SNAPSHOTS, Hello, MachineInfo, TaskSetKind
from rce.control.model import EndpointSpec, EndpointState, EndpointStatus, LinkAddress
from rce.model.specs import InterfaceSpec, Network, NodeSpec, ResourceChanges, Resources
from rce.model.volumes import Volume
from rce_master.exceptions import RefusedError
from rce_master.state import commands
from rce_master.state.changes import Changes
from rce_master.state.core import State
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import User, UserRole
from rce_master.state.volume_moves import phase_began
from rce_master.state.volumes import volumes_of

USERS = st.sampled_from(["ann", "bob"])
TAGS = st.sampled_from(["a", "b", "c", "d"])
INTERFACES = st.sampled_from(["i", "j"])
PATHS = st.builds("{}/{}".format, TAGS, INTERFACES)
ROBOT_SETS = st.sampled_from(["r1", "r2"])
CONTAINER_SETS = st.sampled_from(["c1", "c2", "c3"])
ADDRESSES = st.builds(LinkAddress, unix=st.sampled_from(["", "/x", "/y"]))
TYPES = st.builds(
    "{}{}".format,
    st.sampled_from(["Publisher", "Subscriber", "ServiceClient", "ServiceProvider"]),
    st.sampled_from(["Interface", "Converter"]),
)
STATUSES = st.builds(
    EndpointStatus,
    id=st.builds("{}/{}".format, USERS, TAGS),
    revision=st.integers(0, 300),
    state=st.sampled_from(EndpointState),
    incarnation=st.sampled_from(["1", "2"]),
    address=ADDRESSES,
)
SLOTS = 3
LIMITS = StateSettings(
    move_timeout=3,
    move_rest=2,
    volume_move_timeout=6,
    robot_grace=3,
    container_grace=2,
    placement_timeout=1,
    max_containers=3,
    max_connections=6,
    max_link_connections=4,
)


def in_order(spec: EndpointSpec) -> EndpointSpec:
    return replace(
        spec,
        interfaces=tuple(sorted(spec.interfaces, key=lambda one: one.tag)),
        links=tuple(sorted(spec.links, key=lambda one: one.id)),
        connections=tuple(sorted(spec.connections, key=lambda one: one.id)),
    )


class Histories(RuleBasedStateMachine):
    """Everything that can happen, in any order."""

    limits = LIMITS

    def __init__(self) -> None:
        super().__init__()
        self.state = State(self.limits)
        self.now = 0.0
        self.stored: dict[str, dict[str, bytes]] = {}
        self.numbers: set[int] = set()
        self.revisions: dict[str, int] = {}
        self.replicas: dict[str, DesiredState] = {}
        self.unsaved = 0
        for name in ("ann", "bob"):
            self.do(commands.AddUser(user=User(name=name, role=UserRole.ADMIN, password="", created=0.0)))

    def do(self, command: commands.Command) -> None:
        before = self.image(persistent_only=False)
        known = self.connection_ids()
        try:
            changes = self.state.apply(command, self.now)
        except RefusedError:
            assert self.image(persistent_only=False) == before
            return
        if self.unsaved:
            self.unsaved -= 1
            self.revert(changes)
            assert self.image(persistent_only=False) == before
            return
        for row in changes.rows():
            table = self.stored.setdefault(row.table, {})
            if row.body is None:
                table.pop(row.key, None)
            else:
                table[row.key] = row.body
        new = self.connection_ids() - known
        assert not new & self.numbers, "a connection id was used again"
        self.numbers |= new
        self.follow(changes)
        for id_ in changes.touched:
            revision = self.state.spec(id_).revision
            assert revision > self.revisions.get(id_, 0)
            self.revisions[id_] = revision
        for drop in changes.withdrawals:
            assert drop.revision > self.revisions.get(drop.id, 0) or drop.id in changes.touched

    def revert(self, changes: Changes) -> None:
        """Take back what was not saved, with the work that was done in the same transaction."""
        more = self.state.apply(commands.Continue(), self.now)
        for each in (more, changes):
            each.revert()

    def follow(self, changes: Changes) -> None:
        """Keep what a task set knows that is told of every change in patches."""
        for id_, touched in changes.touched.items():
            patch = self.state.patch(id_, touched)
            there = self.replicas.get(id_)
            if there is None or touched.since == 0:
                self.replicas[id_] = DesiredState(self.state.spec(id_))
            else:
                assert there.fit(patch) is Fit.NEXT
                there.patch(patch)
        for id_ in [id_ for id_ in self.replicas if id_ not in self.state.tables.endpoints]:
            del self.replicas[id_]

    @invariant()
    def patches_add_up_to_the_whole(self) -> None:
        for id_, replica in self.replicas.items():
            assert in_order(replica.whole) == in_order(self.state.spec(id_))

    def connection_ids(self) -> set[int]:
        return {connection.id for connection in self.state.tables.connections}

    def image(self, *, persistent_only: bool) -> dict[str, dict[str, bytes]]:
        return {
            table.name: {table.key(r): table.encode(r) for r in table}
            for table in self.state.tables.all
            if table.persistent or not persistent_only
        }

    @invariant()
    def holds(self) -> None:
        self.state.validate()
        for endpoint in self.state.tables.endpoints:
            assert self.state.spec(endpoint.id).id == endpoint.id

    @invariant()
    def promises_no_more_than_there_is(self) -> None:
        for room in self.state.tables.rooms:
            assert room.slots <= SLOTS, f"{room.process}: {room.slots} slots promised"

    @invariant()
    def is_stored(self) -> None:
        assert {k: v for k, v in self.image(persistent_only=True).items() if v} == {
            k: v for k, v in self.stored.items() if v
        }

    @rule()
    def restart(self) -> None:
        specs = {e.id: self.state.spec(e.id) for e in self.state.tables.endpoints}
        self.state = State.load(self.stored, self.now, self.limits)
        assert {e.id: self.state.spec(e.id) for e in self.state.tables.endpoints} == specs
        # Each master sets the times of these moves anew, and stores them with the next change.
        self.stored["volume_moves"] = self.image(persistent_only=True)["volume_moves"]

    @rule(count=st.integers(1, 3))
    def next_saves_fail(self, count: int) -> None:
        """The store refuses what the next commands change."""
        self.unsaved = count

    @rule(seconds=st.floats(0, 4))
    def tick(self, seconds: float) -> None:
        self.now += seconds
        self.do(commands.Tick())

    @rule()
    def continue_work(self) -> None:
        self.do(commands.Continue())

    @rule(process=ROBOT_SETS, address=ADDRESSES, endpoints=st.lists(STATUSES, max_size=3))
    def robot_set_arrives(self, process: str, address: LinkAddress, endpoints: list[EndpointStatus]) -> None:
        self.arrive(TaskSetKind.ROBOT, process, address, endpoints)

    @rule(process=CONTAINER_SETS, endpoints=st.lists(STATUSES, max_size=3))
    def container_set_arrives(self, process: str, endpoints: list[EndpointStatus]) -> None:
        self.arrive(TaskSetKind.CONTAINER, process, LinkAddress(), endpoints)

    def arrive(
        self, kind: TaskSetKind, process: str, address: LinkAddress, endpoints: list[EndpointStatus]
    ) -> None:
        hello = Hello(
            version=CONTROL_VERSION,
            kind=kind,
            process=process,
            machine=MachineInfo(name=process, slots=SLOTS, networks=("none", "group"), volumes="image"),
            address=address,
            endpoints=tuple(endpoints),
            features=(SNAPSHOTS,) if kind is TaskSetKind.CONTAINER and process != "c3" else (),
        )
        self.do(commands.TaskSetArrived(hello=hello))

    @rule(process=ROBOT_SETS | CONTAINER_SETS)
    def task_set_leaves(self, process: str) -> None:
        self.do(commands.TaskSetLeft(process=process))

    @rule(process=ROBOT_SETS | CONTAINER_SETS, status=STATUSES)
    def status(self, process: str, status: EndpointStatus) -> None:
        self.do(commands.StatusReported(process=process, status=status))

    @rule(process=ROBOT_SETS | CONTAINER_SETS, user=USERS, tag=TAGS)
    def gone(self, process: str, user: str, tag: str) -> None:
        self.do(commands.EndpointGone(process=process, id=f"{user}/{tag}"))

    @rule(process=ROBOT_SETS, user=USERS, tag=TAGS)
    def login(self, process: str, user: str, tag: str) -> None:
        self.do(commands.RobotLogin(process=process, id=f"{user}/{tag}"))

    @rule(user=USERS, password=st.sampled_from(["x", "y"]))
    def set_password(self, user: str, password: str) -> None:
        self.do(commands.SetPassword(name=user, password=password))

    @rule(user=USERS, role=st.sampled_from([UserRole.ADMIN, UserRole.VIEWER]))
    def set_role(self, user: str, role: UserRole) -> None:
        self.do(commands.SetRole(name=user, role=role))

    @rule(process=ROBOT_SETS, user=USERS, tag=TAGS)
    def robot_leaves(self, process: str, user: str, tag: str) -> None:
        self.do(commands.RobotLeft(process=process, id=f"{user}/{tag}"))

    @rule(user=USERS, tag=TAGS, size=st.sampled_from([1, 2]), wait=st.booleans(), grouped=st.booleans())
    def create(self, user: str, tag: str, size: int, wait: bool = False, grouped: bool = False) -> None:
        requested = (
            Resources(size=size, network=Network.GROUP, group="g") if grouped else Resources(size=size)
        )
        self.do(commands.CreateContainer(user=user, tag=tag, resources=requested, wait=wait))

    @rule(user=USERS, tag=TAGS, name=st.sampled_from(["v", "w"]), wait=st.booleans(), grouped=st.booleans())
    def create_with_volume(self, user: str, tag: str, name: str, wait: bool, grouped: bool) -> None:
        volumes = (Volume(name=name, path="/v", size=64 << 20),)
        resources = (
            Resources(volumes=volumes, network=Network.GROUP, group="g")
            if grouped
            else Resources(volumes=volumes)
        )
        self.do(commands.CreateContainer(user=user, tag=tag, resources=resources, wait=wait))

    @rule(user=USERS, name=st.sampled_from(["v", "w"]))
    def remove_volume(self, user: str, name: str) -> None:
        self.do(commands.RemoveVolume(user=user, name=name))

    @rule(first=st.booleans())
    def volume_is_removed(self, first: bool) -> None:
        for removal in list(self.state.tables.volume_removals)[: 1 if first else None]:
            self.do(commands.VolumeRemoved(process=removal.process, volume=removal.volume))

    @rule(fails=st.booleans(), is_last=st.booleans(), late=st.booleans())
    def snapshots_are_taken(self, fails: bool, is_last: bool, late: bool) -> None:
        for known in list(self.state.tables.volumes):
            if known.process:
                command = commands.SnapshotTaken(
                    process=known.process,
                    volume=known.id,
                    placement=known.placement,
                    is_last=is_last,
                    since=None if late else phase_began(self.state.tables, known.id),
                    snapshot="" if fails else "5" * 64,
                    error="the disk is full" if fails else "",
                )
                self.do(command)

    @rule(fails=st.booleans())
    def volumes_are_restored(self, fails: bool) -> None:
        for move in list(self.state.tables.volume_moves):
            container = self.state.tables.container(move.id)
            assert container is not None
            for known in volumes_of(self.state.tables, container):
                command = commands.VolumeRestored(
                    process=move.to,
                    volume=known.id,
                    placement=known.placement + 1,
                    error="a wrong hash" if fails else "",
                )
                self.do(command)

    @invariant()
    def volumes_never_run_twice(self) -> None:
        """A container runs nowhere while its volumes move, and later only where their newest files are."""
        for container in self.state.tables.containers():
            if container.id in self.state.tables.volume_moves or not container.task_set:
                continue
            for known in volumes_of(self.state.tables, container):
                assert known.process == container.task_set

    @rule(user=USERS, tag=TAGS, size=st.sampled_from([1, 2, 3, 4]))
    def resize(self, user: str, tag: str, size: int) -> None:
        self.do(commands.ResizeContainer(user=user, tag=tag, changes=ResourceChanges(size=size)))

    @rule(process=CONTAINER_SETS, draining=st.booleans())
    def drain(self, process: str, draining: bool) -> None:
        self.do(commands.SetDraining(machine=process, draining=draining))

    @rule(user=USERS, tag=TAGS, process=CONTAINER_SETS)
    def move(self, user: str, tag: str, process: str) -> None:
        self.do(commands.MoveContainer(user=user, tag=tag, machine=process))

    @rule(state=st.sampled_from(EndpointState), leave=st.booleans())
    def copies_report(self, state: EndpointState, leave: bool) -> None:
        for move in list(self.state.tables.moves):
            if leave:
                self.do(commands.EndpointGone(process=move.to, id=move.id))
            else:
                status = EndpointStatus(id=move.id, revision=1, state=state)
                self.do(commands.StatusReported(process=move.to, status=status))

    @rule(user=USERS, tag=TAGS)
    def destroy(self, user: str, tag: str) -> None:
        self.do(commands.DestroyContainer(user=user, tag=tag))

    @rule(user=USERS, tag=TAGS, exe=st.sampled_from(["x", "y"]), remove=st.booleans())
    def node(self, user: str, tag: str, exe: str, remove: bool) -> None:
        if remove:
            self.do(commands.RemoveNode(user=user, container=tag, tag="n"))
        else:
            node = NodeSpec(tag="n", pkg="p", exe=exe)
            self.do(commands.AddNode(user=user, container=tag, node=node))

    @rule(user=USERS, tag=TAGS, value=st.sampled_from([1, True, "x", [1.5]]), remove=st.booleans())
    def parameter(self, user: str, tag: str, value: int, remove: bool) -> None:
        if remove:
            self.do(commands.DeleteParameter(user=user, container=tag, name="p"))
        else:
            self.do(commands.SetParameter(user=user, container=tag, name="p", value=value))

    @rule(user=USERS, tag=TAGS, interface=INTERFACES, type_=TYPES)
    def add_interface(self, user: str, tag: str, interface: str, type_: str) -> None:
        spec = InterfaceSpec(tag=interface, type=type_, message_type="p/T", addr="/x")
        self.do(commands.AddInterface(user=user, endpoint=tag, interface=spec))

    @rule(user=USERS, tag=TAGS, interface=INTERFACES)
    def remove_interface(self, user: str, tag: str, interface: str) -> None:
        self.do(commands.RemoveInterface(user=user, endpoint=tag, tag=interface))

    @rule(user=USERS, a=PATHS, b=PATHS)
    def connect(self, user: str, a: str, b: str) -> None:
        self.do(commands.Connect(user=user, tag_a=a, tag_b=b))

    @rule(user=USERS, a=PATHS, b=PATHS)
    def disconnect(self, user: str, a: str, b: str) -> None:
        self.do(commands.Disconnect(user=user, tag_a=a, tag_b=b))

    @rule()
    def wire(self) -> None:
        """A whole scene at once, which single random steps would seldom reach."""
        self.arrive(TaskSetKind.ROBOT, "r1", LinkAddress(unix="/r"), [])
        self.arrive(TaskSetKind.CONTAINER, "c1", LinkAddress(), [])
        self.do(commands.RobotLogin(process="r1", id="ann/a"))
        self.create("ann", "b", 1)
        self.add_interface("ann", "a", "i", "SubscriberConverter")
        self.add_interface("ann", "b", "i", "PublisherInterface")
        self.connect("ann", "a/i", "b/i")


Histories.TestCase.settings = settings(
    max_examples=30, stateful_step_count=40, deadline=None, suppress_health_check=list(HealthCheck)
)
TestHistories = pytest.mark.slow(pytest.mark.timeout(120)(Histories.TestCase))


class SlicedHistories(Histories):
    """The same while each command does so little that most work is left to later ones."""

    limits = replace_dataclass(LIMITS, max_work=1)


SlicedHistories.TestCase.settings = settings(Histories.TestCase.settings, max_examples=15)
TestSlicedHistories = pytest.mark.timeout(120)(SlicedHistories.TestCase)
