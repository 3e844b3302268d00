"""Logs: gathered by the core, with levels that can be set."""

from __future__ import annotations

import asyncio
import logging
import re
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rce.ros.core import Core
from rce.ros.errors import ServiceFaultError
from rce.ros.logfiles import LogFile, log_folder
from rce.ros.node import Node, Publisher
from rce.ros.node.rosout import KIND, MD5SUM, RosoutHandler
from rce.ros.types import TypeRegistry
from rce.ros.xmlrpc import RpcClient

BATCH = 25
"""Records of a thread between two looks: with as many of the loop, they fit into all queues."""


@pytest.fixture
async def full_core() -> AsyncIterator[Core]:
    async with Core(port=0, rosout=True) as core:
        yield core
        core.graph.validate()


def test_the_log_has_the_checksum_of_its_type() -> None:
    assert TypeRegistry().message(KIND).md5sum == MD5SUM


async def test_records_of_all_nodes_are_gathered(full_core: Core) -> None:
    uri = full_core.uri
    assert full_core.graph.topic_types == {"/rosout": KIND, "/rosout_agg": KIND}
    async with (
        Node("a", argv=[], master_uri=uri) as a,
        Node("b", argv=[], master_uri=uri, intra_process=False) as b,
        Node("viewer", argv=[], master_uri=uri, rosout=False) as viewer,
    ):
        heard = await viewer.subscribe("/rosout_agg", KIND)
        await heard.wait_for_publishers(timeout=10)
        levels = {"debug": 1, "info": 2, "warning": 4, "error": 8, "critical": 16}
        for node in (a, b):
            node.log.setLevel("DEBUG")
            for level in levels:
                getattr(node.log, level)("%s of %s", level, node.name)
        found = set()
        async with asyncio.timeout(60):
            async for record in heard:
                found.add((record.name, record.level, record.msg))
                if len(found) == 10:
                    break
        expected = {(n, value, f"{level} of {n}") for level, value in levels.items() for n in ("/a", "/b")}
        assert found == expected


@pytest.mark.parametrize("intra_process", [True, False])
async def test_records_of_threads_are_published_in_the_loop(
    full_core: Core, intra_process: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Connections and queues belong to the thread of the event loop."""
    threads: set[int] = set()
    publish = Publisher.publish

    def note_thread(publisher: Publisher, **fields: Any) -> None:
        threads.add(threading.get_ident())
        publish(publisher, **fields)

    monkeypatch.setattr(Publisher, "publish", note_thread)
    make = partial(Node, argv=[], master_uri=full_core.uri, intra_process=intra_process)
    async with make("worker") as worker, make("viewer", rosout=False) as viewer:
        heard = await viewer.subscribe("/rosout", KIND)
        await heard.wait_for_publishers(timeout=10)

        def work(start: int) -> None:
            for number in range(start, start + BATCH):
                worker.log.info("thread %d", number)

        async with asyncio.timeout(60):
            for start in range(0, 1000, BATCH):
                working = asyncio.create_task(asyncio.to_thread(work, start))
                for number in range(start, start + BATCH):
                    worker.log.info("loop %d", number)
                    await asyncio.sleep(0)
                await working
                found = [(await anext(heard)).msg for _ in range(2 * BATCH)]
                for source in ("thread", "loop"):
                    expected = [f"{source} {number}" for number in range(start, start + BATCH)]
                    assert [text for text in found if text.startswith(source)] == expected
    assert threads == {threading.get_ident()}


def test_record_of_a_thread_after_the_loop_is_dropped() -> None:
    async def handler_of_a_node() -> logging.Handler:
        async with Core(port=0) as core, Node("a", argv=[], master_uri=core.uri) as node:
            return next(handler for handler in node.log.handlers if isinstance(handler, RosoutHandler))

    handler = asyncio.run(handler_of_a_node())
    with ThreadPoolExecutor(1) as pool:
        pool.submit(handler.handle, logging.makeLogRecord({"msg": "late"})).result()


async def test_records_are_kept_in_a_file(tmp_path: Path) -> None:
    async with (
        Core(port=0, rosout=True, log_folder=tmp_path) as core,
        Node("a", argv=[], master_uri=core.uri) as a,
    ):
        await a.advertise("t", "std_msgs/String")
        file = tmp_path / core.get_param("/run_id") / "rosout.log"
        a.log.error("kept\nin a file")
        async with asyncio.timeout(60):
            while "in a file" not in file.read_text():
                await asyncio.sleep(0.02)
        lines = file.read_text().splitlines()
        assert lines[2].endswith("  Node Startup")
        assert re.fullmatch(
            r"\d+\.\d{9} ERROR /a \[.*test_ros_logs.py:\d+\(test_records_are_kept_in_a_file\)\] "
            r"\[topics: (/rosout, /t|/t, /rosout)\] kept",
            lines[3],
        )
        assert (tmp_path / "latest" / "rosout.log").samefile(file)


async def test_a_folder_that_cannot_be_written_costs_only_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    async with (
        Core(port=0, rosout=True, log_folder=tmp_path / "file") as core,
        Node("a", argv=["__log:=" + str(tmp_path / "file" / "a.log")], master_uri=core.uri),
    ):
        assert {"/rosout", "/a"} <= core.graph.nodes.keys()
    assert "ROS_LOG_DIR names another folder" in caplog.text
    assert "/a has no log file" in caplog.text


def test_files_are_cut_and_old_ones_dropped(tmp_path: Path) -> None:
    file = LogFile(tmp_path / "new" / "x.log", "%(message)s", max_bytes=100, backups=2)
    for number in range(100):
        file.handle(logging.makeLogRecord({"msg": f"record {number}"}))
    file.close()
    assert sorted(path.name for path in file_folder(file).iterdir()) == ["x.log", "x.log.1", "x.log.2"]
    assert all(path.stat().st_size <= 100 for path in file_folder(file).iterdir())
    assert "record 99" in Path(file.baseFilename).read_text()


def file_folder(file: LogFile) -> Path:
    return Path(file.baseFilename).parent


async def test_a_node_keeps_its_own_log(core: Core, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    for argument, file in (("mine.log", "mine.log"), (str(tmp_path / "deep" / "a.log"), "deep/a.log")):
        async with Node("keeper", argv=[f"__log:={argument}"], master_uri=core.uri) as node:
            node.log.warning("for the file")
        node.log.warning("not any longer")
        text = (tmp_path / file).read_text()
        assert re.fullmatch(r"\[ros\.keeper\]\[WARNING\] [\d :,-]+: for the file\n", text)


@pytest.mark.parametrize(
    ("environ", "folder"),
    [
        ({"ROS_LOG_DIR": "/logs", "ROS_HOME": "/ros", "HOME": "/home/x"}, "/logs"),
        ({"ROS_HOME": "/ros", "HOME": "/home/x"}, "/ros/log"),
        ({"HOME": "/home/x"}, "/home/x/.ros/log"),
    ],
)
def test_logs_go_where_those_of_ros_go(environ: dict[str, str], folder: str) -> None:
    assert log_folder(environ) == Path(folder)


async def test_levels_are_read_and_set(core: Core) -> None:
    async with (
        Node("levels", argv=[], master_uri=core.uri) as a,
        Node("b", argv=[], master_uri=core.uri) as b,
    ):
        a.log.setLevel("INFO")  # as nodes begin; loggers outlive their node
        a.log.getChild("part").setLevel("ERROR")
        get = b.service_client("/levels/get_loggers", "roscpp/GetLoggers")
        set_level = b.service_client("/levels/set_logger_level", "roscpp/SetLoggerLevel")
        loggers = {entry.name: entry.level for entry in (await get.call({}, timeout=10)).loggers}
        assert loggers["rosout"] == "info"
        assert loggers["rosout.part"] == "error"
        await set_level.call({"logger": "rosout", "level": "Debug"}, timeout=10)
        loggers = {entry.name: entry.level for entry in (await get.call({}, timeout=10)).loggers}
        assert loggers["rosout"] == "debug"
        with pytest.raises(ServiceFaultError, match="no logger"):
            await set_level.call({"logger": "other", "level": "info"}, timeout=10)
        with pytest.raises(ServiceFaultError, match="not one of"):
            await set_level.call({"logger": "rosout", "level": "loud"}, timeout=10)


async def test_the_core_answers_as_a_roslaunch_process_does(core: Core) -> None:
    (uri,) = core.get_param("/roslaunch/uris").values()
    assert uri == core.uri
    async with RpcClient() as rpc:
        assert (await rpc.call(uri, "get_pid", ()))[0] == 1
        assert await rpc.call(uri, "get_node_names", ()) == [1, "node names", []]
        assert (await rpc.call(uri, "list_processes", ()))[2] == [[], []]
        assert (await rpc.call(uri, "process_info", ("x",)))[0] == -1
