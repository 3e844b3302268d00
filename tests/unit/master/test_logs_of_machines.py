"""Which machine is asked for a log, and whose answer counts."""

from __future__ import annotations

import pytest

from rce.control.exceptions import PeerTimeoutError
from rce.control.logs import LogQuery
from rce.control.messages import LogChunk, MachineInfo, TaskSetKind
from rce.control.model import EndpointState, EndpointStatus
from rce_master.exceptions import NotFoundError, TaskSetAwayError
from rce_master.logs import LogRequest, read_log
from rce_master.state.lifecycle import ContainerPhase
from rce_master.state.records import Container, ContainerLive, TaskSet
from rce_master.state.tables import Tables
from rce_master.state.user_records import User, UserRole

BOX = "anna/box"
PREVIOUS = LogQuery(previous=True)


class Machine:
    """A task set that has the logs of one life, or none."""

    def __init__(self, text: str = "", *, ended: float = 0.0, silent: bool = False) -> None:
        self.text = text
        self.ended = ended
        self.silent = silent
        self.queries: list[LogQuery] = []

    async def read_log(
        self,
        id: str,  # noqa: A002
        node: str,
        offset: int = 0,
        limit: int = 65536,
        query: LogQuery = LogQuery(),  # noqa: B008
    ) -> LogChunk:
        self.queries.append(query)
        if self.silent:
            raise PeerTimeoutError("machine", 1.0)
        error = "" if self.text else "no logs of an earlier life of container box are kept here"
        return LogChunk(request=0, offset=0, text=self.text, error=error, ended=self.ended)


class Cloud:
    def __init__(self, *, at: str | None = None, **machines: Machine) -> None:
        self.machines = machines
        self.tables = Tables()
        anna = User(name="anna", role=UserRole.USER, password="", created=17.0)
        self.tables.users.assign("anna", anna)
        for process in (*machines, "robots"):
            kind = TaskSetKind.ROBOT if process == "robots" else TaskSetKind.CONTAINER
            task_set = TaskSet(process=process, kind=kind, machine=MachineInfo(name=process))
            self.tables.task_sets.assign(process, task_set)
        if at is not None:
            self.tables.endpoints.assign(BOX, Container(id=BOX, task_set=at))
            status = EndpointStatus(id=BOX, revision=1, state=EndpointState.RUNNING, incarnation="now")
            live = ContainerLive(id=BOX, phase=ContainerPhase.RUNNING, since=0.0, status=status)
            self.tables.live.assign(BOX, live)
        self.robots = Machine("robots have no logs")

    async def read(self, node: str = "", query: LogQuery = LogQuery()) -> str:  # noqa: B008
        peers = {**self.machines, "robots": self.robots}
        return (await read_log(self.tables, peers, LogRequest(BOX, node, query=query))).text


async def test_a_container_is_read_where_it_is() -> None:
    cloud = Cloud(at="a", a=Machine("here"), b=Machine("there"))
    assert await cloud.read() == "here"
    assert not cloud.machines["b"].queries
    await cloud.read(query=LogQuery(incarnation="now"))
    await cloud.read(query=LogQuery(incarnation="former"))
    assert cloud.machines["a"].queries == [
        LogQuery(),
        LogQuery(incarnation="now"),
        LogQuery(incarnation="former", since=17.0),
    ], "not what was there before its user"
    with pytest.raises(NotFoundError, match="has no node 'x'"):
        await cloud.read("x")
    cloud.machines["a"].silent = True
    with pytest.raises(TaskSetAwayError):
        await cloud.read()


async def test_of_a_container_that_is_gone_the_last_life_counts() -> None:
    older, newer = Machine("older", ended=5.0), Machine("newer", ended=6.0)
    cloud = Cloud(a=older, b=newer, c=Machine(), d=Machine("?", silent=True))
    assert await cloud.read("any") == "newer"
    assert older.queries == [LogQuery(since=17.0)], "not what was there before its user"
    assert not cloud.robots.queries
    with pytest.raises(NotFoundError, match="there is no container 'box'"):
        await Cloud(a=Machine()).read()


async def test_earlier_log_is_searched_here_then_elsewhere() -> None:
    """An earlier life is looked for where the container is and then elsewhere."""
    cloud = Cloud(at="a", a=Machine("here", ended=5.0), b=Machine("there", ended=9.0))
    assert await cloud.read("removed", PREVIOUS) == "here"
    cloud.machines["a"].text = ""
    assert await cloud.read("removed", PREVIOUS) == "there"
    cloud.machines["b"].text = ""
    with pytest.raises(NotFoundError, match="no logs of an earlier life"):
        await cloud.read("removed", PREVIOUS)
    with pytest.raises(NotFoundError, match="no machine is connected"):
        await Cloud(at="away").read("", PREVIOUS)
