"""What every test gets: tool markers, and a check that nothing is leaked."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from functools import cache
from operator import itemgetter
from pathlib import Path

import hypothesis
import psutil
import pytest
from support.short_folders import RUN_PREFIX, TMP, make_folder, sweep_old_folders

TESTS = Path(__file__).parent
REQUIRE_ALL = os.environ.get("RCE_REQUIRE_ALL") == "1"
LEAK_TIMEOUT_S = 3.0
RUN_FOLDER = "RCE_TEST_RUN_FOLDER"
"""Environment variable for :mod:`support.roscpp_programs`: the folder of what all workers of a run share."""
WORKERS_PER_CORE = 3
WORKERS_PER_THREAD = 2
"""Of a core with several threads, which share its time."""

# Nothing fails for being slow: not on a busy machine, nor at the first run, which makes hypothesis's tables.
hypothesis.settings.register_profile(
    "rce", deadline=None, max_examples=60, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.register_profile("quick", hypothesis.settings.get_profile("rce"), max_examples=20)
hypothesis.settings.load_profile("rce")

# A shell's background jobs ignore it, or nohup, and so would all programs that tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def _runs(*argv: str) -> bool:
    try:
        return subprocess.run(argv, capture_output=True, timeout=120, check=False).returncode == 0
    except OSError:
        return False


def _can_run_images() -> bool:
    """Try to make a container, as the engine does."""
    from rce_container.exceptions import RuntimeUnavailableError
    from rce_container.runtimes.podman import PodmanRuntime

    runtime = PodmanRuntime()
    try:
        runtime.probe()
    except RuntimeUnavailableError:
        return False
    runtime.close()
    return True


def _can_make_networks() -> bool:
    """Try with a namespace of an own name and a pair of interfaces in it."""
    name = f"rce-check-{os.getpid()}"
    if not _runs("ip", "netns", "add", name):
        return False
    try:
        inside = ("ip", "-n", name, "link", "add", "name")
        return _runs(*inside, "left", "type", "veth", "peer", "name", "right") and _runs(
            *inside, "switch", "type", "bridge"
        )
    finally:
        _runs("ip", "netns", "del", name)


def _can_limit() -> bool:
    """Try as a container task set does."""
    from rce_container.limits import choose_limiter

    with (
        tempfile.TemporaryDirectory() as scratch,
        contextlib.closing(choose_limiter(f"check-{os.getpid()}", Path(scratch) / "cgroups")) as limiter,
    ):
        return not limiter.missing


_CHECKS: dict[str, tuple[Callable[[], bool], str]] = {
    "bwrap": (
        lambda: _runs("bwrap", "--unshare-all", "--ro-bind", "/", "/", "true"),
        "bubblewrap is not installed or may not make namespaces here (Debian: bubblewrap)",
    ),
    "rospy": (
        lambda: _runs("/usr/bin/python3", "-c", "import rospy"),
        "ROS 1 is not installed (Debian: python3-rospy)",
    ),
    "actionlib": (
        lambda: _runs("/usr/bin/python3", "-c", "import actionlib.msg"),
        "ROS's actionlib is not installed (Debian: python3-actionlib)",
    ),
    "tf2": (
        lambda: _runs("/usr/bin/python3", "-c", "import tf2_ros"),
        "ROS's tf2 is not installed (Debian: python3-tf2-ros)",
    ),
    "rostopic": (
        lambda: shutil.which("rostopic") is not None,
        "rostopic is missing (Debian: python3-rostopic)",
    ),
    "roscpp": (
        lambda: _runs("pkg-config", "--exists", "roscpp") and shutil.which("g++") is not None,
        "roscpp cannot be compiled against (Debian: g++ pkg-config libroscpp-dev libstd-srvs-dev)",
    ),
    "roscpp_sensor_msgs": (
        lambda: (
            _runs("pkg-config", "--exists", "roscpp", "sensor_msgs", "std_msgs")
            and shutil.which("g++") is not None
        ),
        "roscpp's sensor_msgs cannot be compiled against (Debian: g++ pkg-config libsensor-msgs-dev)",
    ),
    "roscpp_actionlib": (
        lambda: _runs("pkg-config", "--exists", "actionlib", "roscpp") and shutil.which("g++") is not None,
        "roscpp's actionlib cannot be compiled against (Debian: g++ pkg-config libactionlib-dev)",
    ),
    "roslaunch": (
        lambda: (
            _runs("/usr/bin/python3", "-c", "import roslaunch, rosmaster, rostest, roswtf")
            and _has_metadata("rosout")
        ),
        "roslaunch or what it starts is missing (Debian: python3-roslaunch python3-roswtf rosout ...)",
    ),
    "ros_msgs": (
        lambda: _runs("/usr/bin/python3", "-c", "import map_msgs, move_base_msgs, pcl_msgs, stereo_msgs"),
        "not all of ROS's messages are installed (Debian: python3-map-msgs python3-pcl-msgs ...)",
    ),
    "rosbag": (
        lambda: shutil.which("rosbag") is not None and _runs("/usr/bin/python3", "-c", "import rosbag"),
        "rosbag is missing (Debian: python3-rosbag)",
    ),
    "rosmsg": (lambda: shutil.which("rosmsg") is not None, "rosmsg is missing (Debian: python3-rosmsg)"),
    "topic_tools": (
        lambda: Path("/usr/lib/topic_tools/relay").exists() and _has_metadata("topic_tools"),
        "topic_tools or its package.xml is missing (Debian: topic-tools libtopic-tools-dev)",
    ),
    "chromium": (lambda: chromium_path() is not None, "Chromium is not installed (Debian: chromium)"),
    "pymunk": (
        lambda: _runs("python3", "-c", "") and _importable("pymunk"),
        "the extra 'fleet' is not installed",
    ),
    "data": (
        lambda: data_folder() is not None,
        "the folder of public maps and logs is absent (set RCE_DATA)",
    ),
    "etcd": (lambda: shutil.which("etcd") is not None, "etcd is missing (Debian: etcd-server)"),
    "iptables": (lambda: shutil.which("iptables") is not None, "iptables is missing (Debian: iptables)"),
    "curl": (lambda: shutil.which("curl") is not None, "curl is missing (Debian: curl)"),
    "openssl": (lambda: shutil.which("openssl") is not None, "openssl is missing (Debian: openssl)"),
    "systemd": (
        lambda: shutil.which("systemd-analyze") is not None,
        "systemd-analyze is missing (Debian: systemd)",
    ),
    "venv packages": (
        lambda: _runs("dpkg-query", "--status", "python3", "python3-venv", "ca-certificates"),
        "Debian's packages of Python are not installed (Debian: python3 python3-venv ca-certificates)",
    ),
    "root": (lambda: os.geteuid() == 0, "needs root"),
    "cgroups": (_can_limit, "no cgroup can be made here (needs root, or a delegated subtree)"),
    "podman": (
        _can_run_images,
        "podman does not work here (Debian: podman crun; needs root, and a store of the kind overlay)",
    ),
    "netns": (_can_make_networks, "may not make network namespaces here (needs root and ip)"),
}


def _has_metadata(package: str) -> bool:
    """Whether ROS's tools find a package: Debian often has its ``package.xml`` apart from its programs."""
    return Path("/usr/share", package, "package.xml").exists()


def _importable(module: str) -> bool:
    import importlib.util

    return importlib.util.find_spec(module) is not None


def chromium_path() -> str | None:
    """The browser to test the page with."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def data_folder() -> Path | None:
    """The folder of public maps and lidar logs, if it is there."""
    folder = Path(os.environ.get("RCE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    return folder if folder.is_dir() else None


@cache
def missing(tool: str) -> str | None:
    """Why ``tool`` cannot be used here, or None. The workers of a run tell each other what they found."""
    check, reason = _CHECKS[tool]
    answer = Path(os.environ[RUN_FOLDER], f"needs {tool}")
    if answer.exists():
        return answer.read_text() or None
    found = "" if check() else reason
    with tempfile.NamedTemporaryFile("w", dir=answer.parent, delete=False) as file:
        file.write(found)
    Path(file.name).replace(answer)
    return found or None


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Keep ``tmp_path`` short in parallel runs: paths of sockets in it have at most 107 bytes."""
    if _is_worker(config):
        config.option.basetemp = str(make_folder())
    else:  # its environment is that of the workers, which it starts later
        os.environ[RUN_FOLDER] = tempfile.mkdtemp(prefix=RUN_PREFIX, dir=TMP)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove what the workers of this run shared."""
    if not _is_worker(config):
        shutil.rmtree(os.environ.pop(RUN_FOLDER, ""), ignore_errors=True)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Remove a worker's folder, unless a test failed that one may want to look into."""
    if _is_worker(session.config) and not session.testsfailed:
        shutil.rmtree(session.config.option.basetemp, ignore_errors=True)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Hide what is collected from the garbage collector: 400 MB live as long as the run.

    Each full pass would go through them, a third of a second, while tests are collected and in many tests.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks for the groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Prepare a parallel run."""
    _group(items)
    if _is_worker(config):
        _mix(items)


def _group(items: list[pytest.Item]) -> None:
    """Keep tests together, in one worker, that share what is made once or is the machine's.

    What podman keeps is the machine's; what a person finds out about the sandbox takes long. Tests in real
    time have one worker for floors full of robots, and one for machines that fail or are measured: robots of
    several that run late together drive for longer, and may not arrive in time.
    """
    for item in items:
        if item.get_closest_marker("xdist_group"):
            continue
        if chain := item.get_closest_marker("real_time"):
            item.add_marker(pytest.mark.xdist_group(f"real time of {chain.args[0]}"))
            continue
        callspec = getattr(item, "callspec", None)
        person = callspec and callspec.params.get("person")
        if any("podman" in marker.args for marker in item.iter_markers("needs")):
            item.add_marker(pytest.mark.xdist_group("podman"))
        elif person:
            item.add_marker(pytest.mark.xdist_group(f"person {person}"))
        elif _shares_with_its_module(item):
            item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))


def _mix(items: list[pytest.Item]) -> None:
    """Spread end-to-end tests, which keep the processors busy, among integration tests, which wait more.

    Unit tests come last: they are short, so that the workers end at about the same time.
    """
    kinds = [item.path.relative_to(TESTS).parts[0] for item in items]
    totals, seen = Counter(kinds), Counter[str]()
    places = []
    for kind in kinds:
        places.append(1.0 if kind == "unit" else seen[kind] / totals[kind])
        seen[kind] += 1
    items[:] = [item for _, item in sorted(zip(places, items, strict=True), key=itemgetter(0))]


def _shares_with_its_module(item: pytest.Item) -> bool:
    """Whether a test uses something that its module makes once."""
    info = getattr(item, "_fixtureinfo", None)
    made = info.name2fixturedefs.values() if info is not None else ()
    return any(fixture[-1].scope == "module" for fixture in made)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Remove cgroups and folders of test runs that were killed, once a run."""
    from tools.leaks import sweep_dead_cgroups

    if not _is_worker(session.config):
        sweep_dead_cgroups()
        sweep_old_folders()


def pytest_xdist_auto_num_workers() -> int:
    """Return how many tests run at once: most wait for processes and the clock much of their time."""
    cores = psutil.cpu_count(logical=False)
    has_threads = cores is not None and cores < (psutil.cpu_count() or cores)
    return int((WORKERS_PER_THREAD if has_threads else WORKERS_PER_CORE) * len(os.sched_getaffinity(0)))


def _is_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


def pytest_runtest_setup(item: pytest.Item) -> None:
    for marker in item.iter_markers("needs"):
        for tool in marker.args:
            reason = missing(tool)
            if reason is not None:
                pytest.skip(reason)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Where everything has to be there, a skip is a failure, whichever mark asked for it."""
    report = yield
    if REQUIRE_ALL and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"{reason}; a skip is a failure here (RCE_REQUIRE_ALL=1)"
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the figures that tests recorded by ``record_property("figures", TEXT)``."""
    for reports in terminalreporter.stats.values():
        for report in reports:
            if getattr(report, "when", None) == "call":
                for name, text in report.user_properties:
                    if name == "figures":
                        terminalreporter.section(report.nodeid)
                        terminalreporter.write_line(text)


@pytest.fixture(scope="session")
def rce_data() -> Path:
    """The folder of public maps and lidar logs, for tests that are marked with ``needs("data")``."""
    folder = data_folder()
    assert folder is not None
    return folder


@pytest.fixture(autouse=True)
def _same_loops() -> Iterator[None]:
    """Give inner loops the form back that they had before the test: a node compiles those of all modules."""
    compiled = sys.modules.get("rce_fleet.compiled")
    before = {each: each._used for each in compiled._kernels} if compiled else {}
    yield
    if compiled := sys.modules.get("rce_fleet.compiled"):
        for each in compiled._kernels:
            each._used = before.get(each, each.numpy)


_KEPT = ("/dev/", "anon_inode:", "/proc/")
"""Beginnings of what may stay open: epoll of event loops, and what the interpreter opens once."""
_NOT_KEPT = ("/dev/pts/", "/dev/ptmx", "anon_inode:[pidfd]", "anon_inode:inotify")
_HANDLER = "RequestHandler."
"""Beginning of the names of aiohttp's coroutines that handle requests."""


def _descriptors() -> dict[int, str]:
    found = {}
    for entry in Path("/proc/self/fd").iterdir():
        try:
            found[int(entry.name)] = str(entry.readlink())
        except OSError:
            continue
    return found


def _children() -> list[psutil.Process]:
    """Return this process's descendants; psutil reads about all processes of the machine for that.

    The kernel tells quickly that there is no child, which is so before and after most of the tests.
    """
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return []
    return psutil.Process().children(recursive=True)


def _leaks(fds: dict[int, str], children: set[int], threads: set[threading.Thread]) -> list[str]:
    found = [
        f"descriptor {fd} -> {target}"
        for fd, target in _descriptors().items()
        if fds.get(fd) != target
        and (target.startswith(_NOT_KEPT) or not target.startswith(_KEPT))
        and "__pycache__" not in target
    ]
    found += [f"process {child.pid} {child.name()}" for child in _children() if child.pid not in children]
    found += [
        f"thread {thread.name}"
        for thread in threading.enumerate()
        if thread not in threads
        and thread.is_alive()
        and not thread.daemon
        and not thread.name.startswith("asyncio_")
    ]
    return found


@pytest.fixture(autouse=True)
def _no_leaks(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test that leaves a descriptor, a process or a thread behind."""
    if {"shared_engine", "shared_demo", "shared_masters"} & set(request.fixturenames):
        yield
        return
    fds, threads = _descriptors(), set(threading.enumerate())
    children = {child.pid for child in _children()}
    yield
    deadline = time.monotonic() + LEAK_TIMEOUT_S
    while leaks := _leaks(fds, children, threads):
        if time.monotonic() > deadline:
            pytest.fail("left behind: " + "; ".join(leaks))
        gc.collect()
        time.sleep(0.05)


def _tasks(loop: asyncio.AbstractEventLoop) -> list[asyncio.Task[object]]:
    """Return the tasks of a loop, without aiohttp's handlers of requests whose clients left.

    They end with what they send next, or ten seconds later if a body has not come.
    """
    tasks = asyncio.all_tasks(loop)
    return [task for task in tasks if not getattr(task.get_coro(), "__qualname__", "").startswith(_HANDLER)]


@pytest.fixture(autouse=True)
def _no_tasks(request: pytest.FixtureRequest, _no_leaks: None) -> Iterator[None]:
    """Fail an async test that leaves a task behind, which the end of its event loop would cancel.

    Loops that the tests of a module share are left out, because what serves all of them runs there.
    """
    if "_function_scoped_runner" not in request.fixturenames:
        yield
        return
    runner: asyncio.Runner = request.getfixturevalue("_function_scoped_runner")
    yield
    deadline = time.monotonic() + LEAK_TIMEOUT_S
    while tasks := _tasks(runner.get_loop()):
        if time.monotonic() > deadline:
            pytest.fail("left behind: " + "; ".join(map(repr, tasks)))
        runner.run(asyncio.sleep(0.005))
