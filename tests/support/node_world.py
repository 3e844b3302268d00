"""A machine for tests of what is decided about a container's nodes."""

from __future__ import annotations

from typing import Unpack

from rce.control.model import NodeState, NodeStatus
from rce.model.specs import NodeSpec
from rce_container.environment.nodes import events as e
from rce_container.environment.nodes.core import NodesCore
from support.parts import NodeLife


def spec(tag: str = "a", args: str = "", **life: Unpack[NodeLife]) -> NodeSpec:
    return NodeSpec(tag=tag, pkg="own", exe="x.py", args=args, **life)


class World:
    """A machine that does what the core says, at once or when a test wants it."""

    def __init__(self, *specs: NodeSpec) -> None:
        self.core = NodesCore()
        self.now = 0.0
        self.alive: dict[str, int] = {}
        """Lives that have a process, by tag."""
        self.halting: dict[str, float] = {}
        self.done: set[str] = set()
        """Nodes whose last life ended with exit code 0."""
        self.desired: dict[str, NodeSpec] = {}
        self.told: list[str] = []
        self.notes: list[str] = []
        self.launched: list[str] = []
        self.halted: list[str] = []
        self.desire(*specs)

    def do(self, event: e.Event) -> None:
        for one in self.core.handle(event, self.now):
            match one:
                case e.Launch(tag=tag, life=life):
                    assert tag not in self.alive, "two processes of a node"
                    states = self.states()
                    for before in self.desired[tag].after:
                        assert states[before] is NodeState.RUNNING or before in self.done, "before its turn"
                    self.done.discard(tag)
                    self.alive[tag] = life
                    self.launched.append(tag)
                case e.Halt(tag=tag, life=life, share=share):
                    assert self.alive[tag] == life
                    assert 0 < share <= 1
                    self.halting[tag] = share
                    self.halted.append(tag)
                case e.Tell(text=text):
                    self.told.append(text)
                case e.Note(text=text):
                    self.notes.append(text)
                case e.Forget(tag=tag):
                    assert tag not in self.alive
        self.core.validate()

    def desire(self, *specs: NodeSpec) -> None:
        self.desired = {one.tag: one for one in specs}
        self.done &= set(self.desired)
        self.do(e.Desire(specs))

    def made(self, tag: str = "a") -> None:
        self.do(e.Made(tag, self.alive[tag], 100 + self.alive[tag]))

    def register(self, tag: str = "a") -> None:
        self.do(e.Registered(tag, self.alive[tag]))

    def end(self, tag: str = "a", code: int = 3) -> None:
        life = self.alive.pop(tag)
        if code == 0 and tag not in self.halting:
            self.done.add(tag)
        self.halting.pop(tag, None)
        self.do(e.Ended(tag, life, code, f"exit code {code}"))

    def refuse(self, tag: str = "a", *, hopeless: bool = True) -> None:
        self.halting.pop(tag, None)
        self.do(e.Refused(tag, self.alive.pop(tag), "no package 'x'", hopeless))

    def wait(self, seconds: float) -> None:
        """Let time pass, with a tick at every deadline, as a timer would."""
        end = self.now + seconds
        for _ in range(10_000):
            if (deadline := self.core.deadline) > end:
                break
            self.now = max(self.now, deadline)
            self.do(e.Tick())
        else:
            raise AssertionError("ticks indefinitely")
        self.now = end

    def status(self, tag: str = "a") -> NodeStatus:
        return next(status for status in self.core.statuses if status.tag == tag)

    def states(self) -> dict[str, NodeState]:
        return {status.tag: status.state for status in self.core.statuses}
