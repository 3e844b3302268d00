"""A small world around the master's state."""

from __future__ import annotations

from typing import Unpack

from rce.control.messages import CONTROL_VERSION, Hello, MachineInfo, TaskSetKind
from rce.control.model import EndpointSpec, EndpointState, EndpointStatus, LinkAddress
from rce.model.specs import InterfaceSpec, NodeSpec, Resources
from rce_master.state import commands
from rce_master.state.changes import Changes
from rce_master.state.core import State
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import User, UserRole
from support.parts import MachineParts, ResourceParts, StatusParts


class World:
    """A state with a clock in the test's hand; invariants are checked after every command."""

    def __init__(self, settings: StateSettings | None = None) -> None:
        self.state = State(settings)
        self.now = 1000.0
        self.user("anna")

    def do(self, command: commands.Command) -> Changes:
        try:
            return self.state.apply(command, self.now)
        finally:
            self.state.validate()

    def user(self, name: str, role: UserRole = UserRole.USER) -> None:
        self.do(commands.AddUser(user=User(name=name, role=role, password="x", created=0.0)))

    def robot_set(
        self, process: str = "r1", endpoints: tuple[EndpointStatus, ...] = (), port: int = 1
    ) -> Changes:
        return self.do(
            commands.TaskSetArrived(
                hello=Hello(
                    version=CONTROL_VERSION,
                    kind=TaskSetKind.ROBOT,
                    process=process,
                    machine=MachineInfo(name="m"),
                    url=f"ws://{process}/",
                    address=LinkAddress(machine="m", host="h", port=port),
                    endpoints=endpoints,
                )
            )
        )

    def container_set(
        self,
        process: str = "c1",
        endpoints: tuple[EndpointStatus, ...] = (),
        name: str = "m",
        *,
        draining: bool = False,
        features: tuple[str, ...] = (),
        **machine: Unpack[MachineParts],
    ) -> Changes:
        return self.do(
            commands.TaskSetArrived(
                hello=Hello(
                    version=CONTROL_VERSION,
                    kind=TaskSetKind.CONTAINER,
                    process=process,
                    machine=MachineInfo(name=name, draining=draining, **machine),
                    endpoints=endpoints,
                    features=features,
                )
            )
        )

    def leave(self, process: str) -> Changes:
        return self.do(commands.TaskSetLeft(process=process))

    def login(
        self, robot: str = "rob", process: str = "r1", user: str = "anna", *, arrives: bool = True
    ) -> Changes:
        """A robot logs in, and its task set reports that it is there."""
        id_ = f"{user}/{robot}"
        changes = self.do(commands.RobotLogin(process=process, id=id_))
        if arrives:
            self.report(process, EndpointStatus(id=id_, revision=1, state=EndpointState.RUNNING))
        return changes

    def container(
        self, tag: str = "c", user: str = "anna", *, wait: bool = False, **resources: Unpack[ResourceParts]
    ) -> Changes:
        requested = Resources(**resources)
        return self.do(commands.CreateContainer(user=user, tag=tag, resources=requested, wait=wait))

    def interface(
        self,
        path: str,
        type_: str,
        message_type: str = "std_msgs/String",
        addr: str | None = None,
        user: str = "anna",
    ) -> Changes:
        endpoint, tag = path.split("/")
        if addr is None:
            addr = f"/{tag}" if type_.endswith("Interface") else ""
        spec = InterfaceSpec(tag=tag, type=type_, message_type=message_type, addr=addr)
        return self.do(commands.AddInterface(user=user, endpoint=endpoint, interface=spec))

    def node(self, container: str, tag: str, exe: str = "run.py") -> Changes:
        node = NodeSpec(tag=tag, pkg="Test", exe=exe)
        return self.do(commands.AddNode(user="anna", container=container, node=node))

    def connect(self, a: str, b: str, user: str = "anna") -> Changes:
        return self.do(commands.Connect(user=user, tag_a=a, tag_b=b))

    def report(self, process: str, status: EndpointStatus) -> Changes:
        return self.do(commands.StatusReported(process=process, status=status))

    def run(self, tag: str = "c", process: str = "c1", **fields: Unpack[StatusParts]) -> Changes:
        """A container reports that it runs."""
        fields.setdefault("address", LinkAddress(machine="m", unix=f"/run/{tag}"))
        return self.report(
            process, EndpointStatus(id=f"anna/{tag}", revision=1, state=EndpointState.RUNNING, **fields)
        )

    def tick(self, seconds: float) -> Changes:
        self.now += seconds
        return self.do(commands.Tick())

    def spec(self, tag: str, user: str = "anna") -> EndpointSpec:
        return self.state.spec(f"{user}/{tag}")

    def phase(self, tag: str = "c") -> str:
        return self.state.tables.container_live(f"anna/{tag}").phase.value

    def session(self, tag: str = "rob") -> str:
        return self.state.tables.robot_live(f"anna/{tag}").session.value

    def wired(self) -> None:
        """A robot and a container, joined by a topic, at one task set each."""
        self.robot_set()
        self.container_set()
        self.login()
        self.container()
        self.interface("rob/out", "SubscriberConverter")
        self.interface("c/in", "PublisherInterface")
        self.connect("rob/out", "c/in")


def restarted(world: World, revision: int = 0) -> World:
    snapshot: dict[str, dict[str, bytes]] = {
        table.name: {table.key(r): table.encode(r) for r in table}
        for table in world.state.tables.all
        if table.persistent
    }
    new = World.__new__(World)
    new.now = world.now + 1
    new.state = State.load(snapshot, new.now, revision=revision)
    new.state.validate()
    return new
