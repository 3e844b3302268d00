"""The environment: applies the container's desired state and reports the actual state."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
from pathlib import Path
from typing import assert_never

from rce.control import (
    DesiredState,
    EndpointKind,
    EndpointSpec,
    EndpointState,
    EndpointStatus,
    Fit,
    InterfaceUsage,
    SpecPatch,
    Unknown,
)
from rce.link import Endpoint, HandoverReceiver, LinkHub
from rce.model import EndpointId
from rce_container.environment import messages as m
from rce_container.environment.channel import Channel
from rce_container.environment.executions import Executions
from rce_container.environment.graph import Graph
from rce_container.environment.logs.rosout import RosoutLog
from rce_container.environment.managers import Managers
from rce_container.environment.node_states import NodeStateKeeper
from rce_container.environment.nodes.causes import Causes
from rce_container.environment.nodes.fork_server import NodeForkServer
from rce_container.environment.nodes.heartbeats import Heartbeats
from rce_container.environment.nodes.node_life import NodeContext
from rce_container.environment.nodes.node_set import NodeSet
from rce_container.environment.nodes.reaper import Reaper
from rce_container.environment.parameters import Values, difference, evaluate_all
from rce_container.environment.process import kill_marked
from rce_container.environment.reach import DialProxy
from rce_container.environment.reporting import Reporter
from rce_container.environment.ros1_graph import ros1_graph
from rce_container.environment.user_packages import UserPackages

_log = logging.getLogger(__name__)

_UNUSED = InterfaceUsage()


class Environment:
    """One container, seen from the inside. Its :meth:`run` lasts as long as the container.

    It ends when a manager says so, when :meth:`end` is called, or when no manager was connected for the
    grace time.

    Args:
        boot: The manager's description of the container.
        control: A listening unix socket; managers connect to it.
        links: A listening unix socket; accepts peers' links.
        node_server: Starts nodes that are Python scripts; None for none.
    """

    def __init__(
        self,
        boot: m.Boot,
        control: socket.socket,
        links: socket.socket,
        node_server: NodeForkServer | None = None,
    ) -> None:
        self._boot = boot
        self._managers = Managers(control, boot.grace, self)
        self._links = links
        self._node_server = node_server
        self._loop = asyncio.get_running_loop()
        self._ending = asyncio.Event()
        self._end_reason = ""
        self._desired = DesiredState(EndpointSpec(id=boot.id, kind=EndpointKind.CONTAINER, revision=-1))
        self._patches: list[SpecPatch] = []
        """Changes of interfaces and connections that are to be applied, unless all of them are due."""
        self._all_due = False
        self._holds_back = False
        """Whether interfaces wait for packages."""
        self._applied_revision = -1
        self._news = asyncio.Event()
        self._parameters: Values = {}
        self._faulty: set[str] = set()
        self._report_due: asyncio.Handle | None = None
        self._handover: HandoverReceiver | None = None
        self._user_packages = UserPackages(boot.user_packages, boot.packages)
        self._packages = self._user_packages.index
        self._dial_proxy = DialProxy(self._managers.send)
        self._causes = Causes(self._managers.send)

    async def run(self) -> None:
        """Run the container; return when all its processes, sockets and tasks have ended."""
        async with contextlib.AsyncExitStack() as stack:
            reaper = stack.enter_context(Reaper(self._node_server))
            self._executions = Executions(reaper, self._environ, self._boot.mark, self._boot.home)
            boot = self._boot
            graph = await stack.enter_async_context(
                ros1_graph(boot.address, boot.ros_port, self._packages, lambda: self._nodes.is_settling)
            )
            self._graph: Graph = graph
            self._node_states = NodeStateKeeper(graph, self._managers)
            dial = self._dial_proxy.connect if self._boot.isolated else None
            hub = LinkHub(self._boot.machine, dial=dial, tls=self._boot.tls)
            stack.push_async_callback(hub.close)
            await hub.listen_socket(self._links)
            self._hub = hub
            async with asyncio.TaskGroup() as tasks:
                self._nodes = NodeSet(self._context(reaper), tasks)
                self._rosout = stack.enter_context(contextlib.closing(self._keep_records()))
                await graph.follow_records(self._rosout.take)
                self._heartbeats = Heartbeats(graph, self._nodes.beat, self._fault)
                self._endpoint = Endpoint(
                    EndpointId.parse(self._boot.id),
                    graph.make_interface,
                    hub,
                    on_change=self._changed,
                    on_fault=self._fault,
                )
                self._reporter = Reporter(self._endpoint)
                applying = tasks.create_task(self._apply_changes(), name="endpoint")
                serving = tasks.create_task(self._managers.serve(tasks), name="control socket")
                watching = tasks.create_task(graph.watch_nodes(self), name="graph")
                await self._ending.wait()
                applying.cancel()
                await self._close()
                serving.cancel()
                watching.cancel()
        _log.info("ended: %s", self._end_reason)

    def end(self, reason: str) -> None:
        """Begin to end the whole container."""
        _log.info("ending: %s", reason)
        self._end_reason = self._end_reason or reason
        self._ending.set()
        self._managers.stop_waiting()

    async def _close(self) -> None:
        await self._executions.close()
        await self._node_states.close()
        await self._endpoint.close()
        await self._nodes.close()
        if not self._boot.isolated:
            await kill_marked(self._boot.mark)
        self._report()
        if self._handover is not None:
            await self._handover.close()
        if self._report_due is not None:
            self._report_due.cancel()
        self._managers.close()

    def _keep_records(self) -> RosoutLog:
        return RosoutLog(Path(self._boot.logs), self._nodes.log_of, self._loop.time)

    def _context(self, reaper: Reaper) -> NodeContext:
        return NodeContext(
            reaper=reaper,
            launch_environment=lambda node: self._user_packages.launch_environment(node, self._environ()),
            mark=self._boot.mark,
            home=self._boot.home,
            logs=Path(self._boot.logs),
            interrupt_timeout=self._boot.interrupt_timeout,
            terminate_timeout=self._boot.terminate_timeout,
            on_change=self._changed,
            on_fault=self._fault,
            keep_state=self._node_states.states.keep,
            why_killed=self._causes.ask,
        )

    def _environ(self) -> dict[str, str]:
        packages = os.pathsep.join(map(str, self._packages.path))
        return {
            **os.environ,
            **self._graph.variables,
            "PYTHONUNBUFFERED": "1",
            "RCE_PACKAGE_PATH": packages,
            "ROS_PACKAGE_PATH": packages,
        }

    # Desired state

    def _apply(self, spec: EndpointSpec) -> None:
        if spec.revision < self._desired.revision or self._ending.is_set():
            return
        self._desired.replace(spec)
        self._apply_contents()
        self._apply_all()

    def _apply_patch(self, channel: Channel, patch: SpecPatch) -> None:
        fit = self._desired.fit(patch)
        if fit is Fit.GAP:
            channel.send(m.encode(m.SpecWanted()))
        if fit is not Fit.NEXT or self._ending.is_set():
            return
        self._desired.patch(patch)
        self._patches.append(patch)
        if patch.contents is not None:
            self._apply_contents()
        self._news.set()

    def _apply_contents(self) -> None:
        """Apply the desired parameters and nodes."""
        contents = self._desired.contents
        self._user_packages.apply(contents.packages)
        self._set_parameters()
        self._nodes.lack(self._user_packages.lacking(contents.nodes))
        self._nodes.apply(contents.nodes)

    def _apply_all(self) -> None:
        """Schedule a check of all interfaces and connections."""
        self._all_due = True
        self._patches.clear()
        self._news.set()

    def _take_user_packages(self) -> None:
        """Continue with the nodes and interfaces that waited for packages which have arrived."""
        self._user_packages.look()
        self._set_parameters()
        self._nodes.lack(self._user_packages.lacking(self._desired.contents.nodes))
        self._apply_all()

    def _set_parameters(self) -> None:
        parameters = self._desired.contents.parameters
        desired, faults = evaluate_all(parameters, self._packages, self._environ())
        change = difference(self._parameters, desired)
        for name in change.delete:
            self._graph.delete_parameter(name)
        for name, value in change.set.items():
            self._graph.set_parameter(name, value)
        self._parameters = desired
        if self._user_packages.is_waiting:  # they may name a package that is still to come
            return
        texts = {str(fault) for fault in faults}
        for text in sorted(texts - self._faulty):
            self._fault(text)
        self._faulty = texts

    async def _apply_changes(self) -> None:
        while True:
            await self._news.wait()
            await self._packages.look_ahead()  # interfaces look up their types
            self._news.clear()
            patches, self._patches = self._patches, []
            is_whole = self._all_due or self._holds_back or self._user_packages.is_waiting
            self._all_due = False
            desired = self._desired.whole if is_whole else None
            revision = self._desired.revision
            if desired is not None or any(patch.contents is not None for patch in patches):
                await self._heartbeats.follow(self._desired.contents.nodes)
            if desired is None:
                for patch in patches:
                    await self._endpoint.patch(patch)
            else:
                await self._apply_possible(desired)
            self._applied_revision = revision
            self._changed()

    async def _apply_possible(self, desired: EndpointSpec) -> None:
        """Make all interfaces and connections, except those that wait for packages."""
        possible = self._user_packages.hold_back(desired, self._endpoint.desired_interfaces)
        self._holds_back = possible is not desired
        await self._endpoint.apply(possible)

    # Actual state

    def _changed(self) -> None:
        if self._report_due is None:
            self._report_due = self._loop.call_soon(self._report)

    def _report(self) -> None:
        self._report_due = None
        channel = self._managers.channel
        if channel is None:
            return
        header = EndpointStatus(
            id=self._boot.id,
            revision=self._applied_revision,
            state=self._state,
            nodes=self._nodes.statuses,
        )
        self._reporter.report(channel, header)

    @property
    def _state(self) -> EndpointState:
        if self._ending.is_set():
            return EndpointState.STOPPING
        return EndpointState.DEGRADED if self._nodes.is_degraded else EndpointState.RUNNING

    def _fault(self, text: str) -> None:
        _log.warning("%s", text)
        self._managers.tell_fault(text)

    # rce_container.environment.graph.NodeListener

    def node_appeared(self, name: str) -> bool:
        """Note that a node of the container has registered."""
        if not self._nodes.registered(name):
            return False
        self._rosout.known(name)
        return True

    def node_identified(self, name: str, pid: int) -> None:
        """Note the process of a node that has registered."""
        if self._nodes.registered_process(name, pid):
            self._rosout.known(name)

    # rce_container.environment.managers.ManagerListener

    def manager_arrived(self, _: Channel) -> None:
        """Report the whole state to a new manager."""
        self._node_states.vault.begin()
        self._reporter.begin()
        self._report()

    async def handle(self, channel: Channel, message: m.ToEnvironment | Unknown) -> None:
        """Carry out a manager's request."""
        match message:
            case m.Apply(spec=spec):
                self._apply(spec)
            case m.ApplyPatch(patch=patch):
                self._apply_patch(channel, patch)
            case m.Shelved():
                self._take_user_packages()
            case m.Poll():
                used = {tag: one for tag, one in self._endpoint.usage().items() if one != _UNUSED}
                counters = m.Counters(interfaces=used, traffic=self._endpoint.traffic)
                channel.send(m.encode(counters))
            case m.Dialed(request=request, error=error):
                self._dial_proxy.answered(request, error or socket.socket(fileno=channel.take_fd()))
            case m.Cause(request=request, text=text):
                self._causes.answered(request, text)
            case m.Handover(features=features):
                self._reporter.learn(features)
                self._node_states.vault.learn(features)
                if self._handover is not None:
                    await self._handover.close()
                self._handover = HandoverReceiver(socket.socket(fileno=channel.take_fd()), self._hub.adopt)
            case m.Execute() | m.SaveState() | m.OpenState() | m.StateDone() | m.Stop() | Unknown():
                self._take_order(channel, message)
            case _:
                assert_never(message)

    def _take_order(
        self,
        channel: Channel,
        message: m.Execute | m.SaveState | m.OpenState | m.StateDone | m.Stop | Unknown,
    ) -> None:
        match message:
            case m.SaveState() | m.OpenState() | m.StateDone():
                self._node_states.handle(channel, message)
            case m.Execute(command=command):
                self._executions.start(command, socket.socket(fileno=channel.take_fd()))
            case m.Stop():
                self.end("the manager says so")
            case Unknown(name=name):
                _log.info("the manager sent a %s, which this release does not know", name)
            case _:
                assert_never(message)
