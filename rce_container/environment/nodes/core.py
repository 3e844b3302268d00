"""Decisions about a container's nodes: events in, instructions out. Pure: no I/O, no clock, no task.

A node has several lives, numbered over all nodes. Events of an ended life are ignored. A node never has two
processes: its next life is launched after all processes of the last one have ended.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import count
from typing import assert_never

from rce.aio.backoff import Backoff
from rce.control import NodeState, NodeStatus
from rce.model import NodeSpec
from rce_container.environment.nodes.events import (
    Beat,
    Desire,
    Ended,
    Event,
    Forget,
    Halt,
    Instruction,
    Lack,
    Launch,
    Made,
    Note,
    Refused,
    Registered,
    Restored,
    Tell,
    Tick,
    Unsaved,
)
from rce_container.environment.nodes.life import LifeEvent
from rce_container.environment.nodes.order import StartOrder, levels, ready_to_end
from rce_container.environment.nodes.record import LAST_CHANCE_S, Node

BACKOFF = Backoff(first=0.5, longest=30.0)
"""Delays before a node that ended is started again."""
FIRST_BEAT_WITHIN_S = 30.0
"""Seconds from a node's start within which its first heartbeat has to arrive."""
REGISTERS_WITHIN_S = 10.0
"""A node that did not register with the ROS core within this time probably never will."""
SETTLES_WITHIN_S = 0.5
"""A node's other registrations follow its first one within this time."""
SOON_S = 5.0
"""A node that is started again within this time is worth waiting for."""

_RESTORES = "its state is restored"
_UNREGISTERED = "it has not registered with the ROS core; nodes that come after it wait until it does"


class NodesCore:
    """All nodes of one container.

    Invariants: a node is known while it is desired or has a process; it has one process at most.
    """

    def __init__(self) -> None:
        self._nodes: dict[str, Node] = {}
        self._order = StartOrder()
        self._impossible: dict[str, str] = {}
        """Nodes that can never start with the present specifications, with the reason."""
        self._lacking: Mapping[str, str] = {}
        """Nodes that lack what they are launched with, with the reason."""
        self._lives = count(1)
        self._out: list[Instruction] = []
        self._now = 0.0

    def handle(self, event: Event, now: float) -> list[Instruction]:
        """Handle an event; return the resulting instructions.

        Args:
            event: What happened.
            now: Seconds on a monotonic clock.
        """
        self._now, self._out = now, []
        match event:
            case Desire(specs=specs):
                self._desire({spec.tag: spec for spec in specs})
            case Lack(texts=texts):
                self._lacking = texts
            case Beat(tag=tag):
                if not self._beat(tag):
                    return []
            case Tick():
                self._tick()
            case Made() | Refused() | Registered() | Restored() | Unsaved() | Ended():
                node = self._nodes.get(event.tag)
                if node is not None and node.life == event.life and node.has_process:
                    self._happen(node, event)
            case _:
                assert_never(event)
        self._end_those_whose_turn_it_is()
        self._launch_those_whose_turn_it_is()
        return self._out

    # Queries

    @property
    def statuses(self) -> tuple[NodeStatus, ...]:
        """Return the nodes' statuses, by tag."""
        return tuple(self._nodes[tag].status() for tag in sorted(self._nodes))

    @property
    def is_degraded(self) -> bool:
        """Whether a node failed, is stuck, pauses after a failure, or did not get its state."""
        return any(
            node.state in (NodeState.FAILED, NodeState.STUCK)
            or (node.unrestored and node.has_process)
            or (node.failing and node.state in (NodeState.WAITING, NodeState.STOPPING))
            for node in self._nodes.values()
        )

    def life(self, tag: str) -> int:
        """Return the number of a node's newest life; 0 if it has none."""
        node = self._nodes.get(tag)
        return node.life if node is not None else 0

    def is_settling(self, now: float) -> bool:
        """Whether a node has yet to register its topics and services, and is likely to do so soon."""
        return any(self._settles_at(node) > now for node in self._nodes.values())

    @property
    def deadline(self) -> float:
        """When the next :class:`Tick` is due; infinity if none is."""
        return min(map(self._deadline, self._nodes.values()), default=math.inf)

    def validate(self) -> None:
        """Check the invariants; for tests."""
        for tag, node in self._nodes.items():
            assert node.spec.tag == tag
            assert node.desired is not None or node.has_process
            assert not node.pid or node.has_process
            limit = node.spec.max_restarts
            assert not limit or node.in_a_row <= limit

    # Events

    def _desire(self, desired: dict[str, NodeSpec]) -> None:
        for tag, node in list(self._nodes.items()):
            spec = desired.get(tag)
            if spec != node.desired:
                self._change(node, spec)
        for tag, spec in desired.items():
            if tag not in self._nodes:
                self._nodes[tag] = Node(spec, spec)
        self._order = StartOrder(desired.values())
        faults = self._order.faults()
        for tag, text in faults.items():
            if self._impossible.get(tag) != text and not self._nodes[tag].has_process:
                self._tell(self._nodes[tag], text)
        self._impossible = faults
        share = 1.0 / max(1, levels(self._leaving_for_good()))
        for node in self._nodes.values():
            if node.desired is None and node.state is not NodeState.STOPPING:
                node.share = share

    def _change(self, node: Node, spec: NodeSpec | None) -> None:
        node.desired = spec
        if spec is None:
            if not node.has_process:
                self._forget(node)
        elif not node.has_process:
            self._renew(node, LifeEvent.RENEW)
        elif node.state is NodeState.STOPPING:
            node.failing = False
        elif not node.is_leaving:  # its process is as desired, only how it is watched changes
            node.spec = spec
            node.in_a_row = 0
            node.silent_at = self._now + FIRST_BEAT_WITHIN_S

    def _happen(self, node: Node, event: Made | Refused | Registered | Restored | Unsaved | Ended) -> None:
        match event:
            case Made(pid=pid):
                node.pid = pid
            case Registered():
                self._register(node)
            case Restored(fault=fault):
                self._restore(node, fault)
            case Unsaved(text=text):
                self._unsave(node, text)
            case Refused(reason=reason, hopeless=hopeless):
                self._note(node, f"cannot be started: {reason}")
                self._end(node, None, f"cannot be started: {reason}", hopeless=hopeless)
            case Ended(code=code, reason=reason):
                self._note(node, f"ended: {reason}")
                self._end(node, code, reason)
            case _:
                assert_never(event)

    def _register(self, node: Node) -> None:
        if node.registered_at is None:
            node.registered_at = self._now
        if node.state is NodeState.STARTING:
            if node.restoring:
                node.detail = _RESTORES
            else:
                self._become(node, LifeEvent.REGISTER)

    def _restore(self, node: Node, fault: str) -> None:
        node.restoring = False
        node.unrestored = bool(fault)
        node.state_fault = f"its state was not restored, and is not saved: {fault}" if fault else ""
        if fault:
            self._note(node, node.state_fault)
            self._tell(node, f"runs, but {node.state_fault}")
        if node.registered_at is not None:
            self._register(node)

    def _unsave(self, node: Node, text: str) -> None:
        if text == node.state_fault:
            return
        node.state_fault = text
        self._note(node, text or "its state is saved again")
        if text:
            self._tell(node, f"runs, but {text}")

    def _beat(self, tag: str) -> bool:
        """Handle a heartbeat; return whether it changes anything."""
        node = self._nodes.get(tag)
        if node is None or not node.has_process:
            return False
        node.silent_at = self._now + node.spec.heartbeat_timeout
        if node.state is not NodeState.STUCK:
            return False
        node.ill_at = math.inf
        self._become(node, LifeEvent.BEAT)
        self._note(node, "its heartbeat is there again")
        return True

    def _tick(self) -> None:
        for node in self._nodes.values():
            if node.is_given_up(self._now):
                node.failing = True
                self._halt(node, node.detail)
            elif node.beats and node.silent_at <= self._now:
                self._stuck(node)
            elif node.is_unregistered and self._now >= node.started_at + REGISTERS_WITHIN_S:
                node.detail = _UNREGISTERED

    def _stuck(self, node: Node) -> None:
        node.ill_at = self._now
        self._become(node, LifeEvent.SILENCE, detail=f"no message on {node.spec.heartbeat} any more")
        again = "; it is restarted" if node.restarts_after(failed=True) else ""
        self._note(node, f"stuck: {node.detail}")
        self._tell(node, f"is stuck: {node.detail}{again}")

    def _end(self, node: Node, code: int | None, reason: str, *, hopeless: bool = False) -> None:
        """Handle the end of a life, or of an attempt to start one."""
        stopped = node.state is NodeState.STOPPING
        node.pid, node.exit_code = 0, code
        if stopped and node.failing:
            reason = f"stuck: {node.detail}; {reason}"
        if node.desired is None:
            self._forget(node)
        elif stopped and not node.failing:
            self._renew(node, LifeEvent.PAUSE)
        elif code == 0 and not stopped:
            self._end_well(node)
        elif hopeless or not node.restarts_after(failed=True):
            self._fail(node, reason)
        else:
            self._again(node, reason, failed=True)

    def _end_well(self, node: Node) -> None:
        node.is_done = True
        if node.restarts_after(failed=False):
            self._again(node, "ended", failed=False)
        else:
            self._become(node, LifeEvent.DONE, detail="ended")

    def _again(self, node: Node, reason: str, *, failed: bool) -> None:
        """Restart a node that ended, after a delay, unless it was restarted too often."""
        if node.ran_well(self._now):
            node.in_a_row = 0
        limit = node.spec.max_restarts
        if limit and node.in_a_row >= limit:
            self._fail(
                node,
                f"{reason}; it was started again {node.in_a_row} times in a row, which is its limit: "
                "to start it again, remove it and add it again, or change it",
            )
            return
        node.in_a_row += 1
        delay = BACKOFF.pause_after(node.in_a_row)
        node.pausing, node.failing, node.due = True, failed, self._now + delay
        self._become(node, LifeEvent.PAUSE, detail=f"{reason}; starts again after {delay:g} s")
        self._note(node, f"starts again after {delay:g} s")
        if failed:
            if node.in_a_row == 1:
                node.told = ""
            self._tell(node, f"{_failure(reason)}; it is started again")

    def _fail(self, node: Node, reason: str) -> None:
        node.failing = True
        self._become(node, LifeEvent.FAIL, detail=reason.removeprefix("cannot be started: "))
        node.told = ""
        self._tell(node, _failure(reason))

    # Instructions

    def _end_those_whose_turn_it_is(self) -> None:
        """Nodes that are not desired end in the reverse of their start order, changed ones at once."""
        turn = ready_to_end(self._leaving_for_good())
        for tag, node in self._nodes.items():
            if node.is_leaving and node.state is not NodeState.STOPPING:
                if node.desired is not None:
                    node.share = 1.0
                    self._halt(node)
                elif tag in turn:
                    self._halt(node)

    def _leaving_for_good(self) -> dict[str, tuple[str, ...]]:
        return {tag: node.spec.after for tag, node in self._nodes.items() if node.desired is None}

    def _launch_those_whose_turn_it_is(self) -> None:
        waiting = [node for node in self._nodes.values() if node.state is NodeState.WAITING]
        due = [node for node in waiting if not node.pausing or node.due <= self._now]
        blocked = [node for node in due if self._is_impossible(node) or self._awaited(node)]
        lacking = [node for node in due if node.spec.tag in self._lacking and node not in blocked]
        for node in due:
            if node not in blocked and node not in lacking and node.desired is not None:
                self._launch(node, node.desired)
        for node in lacking:
            node.detail = self._lacking[node.spec.tag]
        for node in blocked:
            node.detail = self._impossible.get(node.spec.tag) or "waits for " + ", ".join(
                f"{tag} ({self._why(tag)})" for tag in self._awaited(node)
            )

    def _is_impossible(self, node: Node) -> bool:
        return node.spec.tag in self._impossible

    def _awaited(self, node: Node) -> list[str]:
        """Return the nodes that have to be ready before it and are not."""
        assert node.desired is not None, "one that is not desired is forgotten, not waiting"
        return [tag for tag in node.desired.after if not self._nodes[tag].is_ready]

    def _why(self, tag: str) -> str:
        node = self._nodes[tag]
        if node.is_unregistered:
            return "not registered yet"
        return _RESTORES if node.restoring else node.state.value

    def _launch(self, node: Node, spec: NodeSpec) -> None:
        node.life = next(self._lives)
        node.restarts += node.pausing
        node.spec, node.exit_code = spec, None
        node.pausing = node.failing = node.is_done = node.unrestored = False
        node.restoring, node.state_fault = spec.state_services is not None, ""
        node.started_at, node.registered_at, node.ill_at = self._now, None, math.inf
        node.silent_at = self._now + FIRST_BEAT_WITHIN_S
        self._become(node, LifeEvent.LAUNCH)
        self._out.append(Launch(spec.tag, node.life, spec))

    def _halt(self, node: Node, detail: str = "") -> None:
        self._become(node, LifeEvent.HALT, detail=detail)
        self._out.append(Halt(node.spec.tag, node.life, node.share))

    def _renew(self, node: Node, life_event: LifeEvent) -> None:
        """Start again with the desired specification."""
        assert node.desired is not None
        self._become(node, life_event)
        node.spec = node.desired
        node.exit_code, node.told = None, ""
        node.restarts = node.in_a_row = 0
        node.pausing = node.failing = node.is_done = False

    def _forget(self, node: Node) -> None:
        del self._nodes[node.spec.tag]
        self._out.append(Forget(node.spec.tag))

    def _become(self, node: Node, life_event: LifeEvent, *, detail: str = "") -> None:
        node.course.advance(life_event)
        node.detail = detail

    def _note(self, node: Node, text: str) -> None:
        self._out.append(Note(node.spec.tag, text))

    def _tell(self, node: Node, text: str) -> None:
        if text != node.told:
            node.told = text
            self._out.append(Tell(f"node {node.spec.tag} {text}"))

    # Helpers

    def _settles_at(self, node: Node) -> float:
        match node.state:
            case NodeState.STARTING:
                return node.started_at + REGISTERS_WITHIN_S
            case NodeState.RUNNING if node.registered_at is not None:
                return node.registered_at + SETTLES_WITHIN_S
            case NodeState.STOPPING if node.desired is not None:
                return math.inf
            case NodeState.WAITING if node.pausing and node.due - self._now <= SOON_S:
                return node.due + REGISTERS_WITHIN_S
            case (
                NodeState.RUNNING
                | NodeState.STOPPING
                | NodeState.WAITING
                | NodeState.STUCK
                | NodeState.EXITED
                | NodeState.FAILED
            ):
                return -math.inf
            case _:
                assert_never(node.state)

    def _deadline(self, node: Node) -> float:
        return min(self._moments(node), default=math.inf)

    def _moments(self, node: Node) -> Iterator[float]:
        if node.state is NodeState.WAITING and node.pausing and node.due > self._now:
            yield node.due
        if node.is_unregistered and not node.detail:
            yield node.started_at + REGISTERS_WITHIN_S
        if node.beats:
            yield node.silent_at
        if node.is_given_up(math.inf):
            yield node.ill_at + LAST_CHANCE_S


def _failure(reason: str) -> str:
    return reason if reason.startswith("cannot be started") else f"failed: {reason}"
