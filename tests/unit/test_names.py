"""Names that were replaced do not come back: see the glossary for the words to use."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path

import pytest
from support.sources import PACKAGES, ROOT, files, text_of

TREES = (*PACKAGES, "benchmarks", "examples", "tests", "tools")
ENGINE = ("rce", "rce_client", "rce_container", "rce_master", "rce_robot")
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+")


class Kind(Enum):
    """What a name is the name of."""

    CLASS = "class"
    FUNCTION = "function"
    VARIABLE = "variable"
    MODULE = "module"


ANY = frozenset(Kind)


@dataclass(frozen=True, slots=True)
class Ban:
    """Names that must not be used.

    Attributes:
        names: A word (``nursery``) is banned as a part of every name; a name with ``=`` before it
            (``=bear``) only as a whole.
        meaning: What the name stood for.
        use: The words to use instead.
        area: Folders in which it is banned; a folder with ``!`` before it is excepted.
        kinds: What it must not be the name of.
    """

    names: str
    meaning: str
    use: str
    area: tuple[str, ...] = TREES
    kinds: frozenset[Kind] = ANY

    def applies_to(self, path: str) -> bool:
        inside = [part for part in self.area if not part.startswith("!")]
        excepted = [part[1:] for part in self.area if part.startswith("!")]
        return any(_is_under(path, part) for part in inside) and not any(
            _is_under(path, part) for part in excepted
        )

    @property
    def words(self) -> frozenset[str]:
        return frozenset(name for name in self.names.split() if not name.startswith("="))

    @property
    def whole(self) -> frozenset[str]:
        return frozenset(name[1:] for name in self.names.split() if name.startswith("="))


@dataclass(frozen=True, slots=True)
class Name:
    """A name that a file defines."""

    text: str
    line: int
    kind: Kind


CLASS = frozenset({Kind.CLASS})
FUNCTION = frozenset({Kind.FUNCTION})
BANS = (
    Ban("nursery cradle nurseries", "the process that forks environments or nodes", "fork server"),
    Ban("=bear =Birth =Gifts gifts birth", "a request to fork, and what goes with it", "SpawnRequest"),
    Ban("unborn", "an environment that is not ready yet", "is_starting"),
    Ban("tether", "the connection that keeps a process alive", "lifeline"),
    Ban("=rock", "the loop of a server", "serve", kinds=FUNCTION),
    Ban("=die_before_others", "what the kernel kills first", "set_oom_score"),
    Ban("=strike_all", "killing processes of a mark", "kill_marked"),
    Ban("=keep_to_oneself", "a process that others cannot read", "set_dumpable"),
    Ban("=limit_oneself oneself", "limits of a process", "set_rlimits"),
    Ban("=class_name =cls_name =kind_name", "the type of a message", "message_type"),
    Ban("=ContainerData =ResizeData =ContainerSpec", "what a container asks for", "Resources"),
    Ban("realm", "the service of the master's state", "StateService"),
    Ban("desk", "the handler of a control channel", "ControlHandler"),
    Ban("=Visit =doubt doubts", "a login that is not decided, a peer that is checked", "PendingLogin, probe"),
    Ban("=Unit =Life", "one life of a container", "Incarnation", ("rce_container",), CLASS),
    Ban("office workshop headquarters", "a service or listener", "the service that it is: PackageService"),
    Ban("house", "a listener, or a test's set of parts", "NamespaceListener, Admission; the parts' name"),
    Ban("doorman", "what accepts links", "LinkAcceptor"),
    Ban("warden", "what enforces limits", "LimitEnforcer"),
    Ban("conveyor", "the queue to the converters", "ConversionQueue"),
    Ban("courier", "the client's transport", "EngineTransport"),
    Ban("=End", "an interface of a client", "ClientInterface", ("rce_client",), CLASS),
    Ban("parcel", "a message in a queue", "QueuedMessage"),
    Ban("taker", "what takes messages", "Consumer, Receiver, Listener"),
    Ban("=Operator", "a proxy that dials", "DialProxy; the operator is a person", ENGINE, CLASS),
    Ban("cell cells", "a control group", "ControlGroup; a cell is a part of the map", ("rce_container",)),
    Ban("valve", "flow control", "FlowControl"),
    Ban("outfit", "the environment that a program is started in", "LaunchEnvironment"),
    Ban("seat", "a place in a group's network", "Membership"),
    Ban("happening", "what happened", "Event"),
    Ban("wish wishes wished", "what a user asks for", "request, requested, desired, query"),
    Ban(
        "=sound_text =sound_status =sound_counters =sound_node",
        "what an environment reports, made safe",
        "sanitize_*",
    ),
    Ban("neighbourhood", "the table of peers", "PeerTable"),
    Ban("patience", "how long to wait", "timeout; LivenessSettings for the rules of a peer table", ENGINE),
    Ban(
        "complaint complaints",
        "a text about a fault, or a limit on its log lines",
        "failure, LogThrottle, ThrottledLog",
    ),
    Ban("stranger strangers", "a peer that has not authenticated", "unauthenticated", ENGINE),
    Ban("everybody somebody anybody", "who may do it", "any_role, none", ENGINE),
    Ban("anew", "once more", "again, restart; note_time_jump for a clock that jumped", ENGINE),
    Ban("errand errands", "work beside the main task", "background", ENGINE),
    Ban("=hurry", "to end at once", "kill_now", ("rce_container",)),
    Ban("=go_on", "to continue after a pause", "continue_work, resume_sending", ENGINE),
    Ban("=make_up", "to bring the actual state to the desired one", "reconcile", ENGINE),
    Ban("=let_in", "to accept a connection", "admit", ENGINE),
    Ban("=hear", "to take a message", "handle_message, receive", ENGINE),
    Ban("=last_words", "the last output of a process", "last_output", PACKAGES),
    Ban("=look_at", "to check something", "check, update", ENGINE),
    Ban("=bend_back", "a link of an endpoint with itself", "loop_back", ENGINE),
    Ban("=for_ever", "a loop without an end", "the work that it does", PACKAGES),
    Ban("=Play =Stage =Setting", "the demo and its config", "DemoConfig, RunningDemo, Mode", ("rce_fleet",)),
    Ban("roam roamer roaming", "goals at random", "RandomGoals", ("rce_fleet", "tests/unit/demo")),
    Ban("=FleetBooks books", "the planner's state", "FleetState", ("rce_fleet",)),
    Ban("=Children revival revive revivable", "the demo's programs", "ProgramGroup, restart", ("rce_fleet",)),
    Ban("door entrance doorway", "access control", "AccessControl, Authenticator", ("rce_fleet/station",)),
    Ban("person persons", "a user of the station", "StationUser", ("rce_fleet",)),
    Ban("bundle bundles", "nodes and message types of a user", "package", (*TREES, "!tests")),
)
KEPT = {
    ("rce/config/task_set_settings.py", "strangers"): "a key of settings files",
    ("rce/config/task_set_settings.py", "bundle_space"): "a key of settings files",
    ("rce_container/settings.py", "bundle_space"): "a key of settings files",
    ("rce_container/settings.py", "BUNDLE_SPACE"): "the default of a key of settings files",
    ("rce_container/runtimes/namespace.py", "BUNDLES"): "a path that nodes of users see",
}


def _is_under(path: str, folder: str) -> bool:
    return path == folder or path.startswith(f"{folder}/")


def names_of(path: str, text: str) -> Iterator[Name]:
    """Return the names that a file defines: its own, and those of classes, functions and variables."""
    yield Name(Path(path).stem, 1, Kind.MODULE)
    for node in ast.walk(ast.parse(text)):
        for name, kind in _names_of_node(node):
            yield Name(name, getattr(node, "lineno", 1), kind)


def _names_of_node(node: ast.AST) -> list[tuple[str, Kind]]:
    match node:
        case ast.ClassDef(name=name):
            return [(name, Kind.CLASS)]
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
            return [(name, Kind.FUNCTION)]
        case (
            ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store())
        ):
            return [(name, Kind.VARIABLE)]
        case ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)) | ast.alias(asname=str(name)):
            return [(name, Kind.VARIABLE)]
        case ast.ExceptHandler(name=str(name)):
            return [(name, Kind.VARIABLE)]
        case _:
            return []


@cache
def bans_of(folder: str) -> tuple[dict[str, Ban], dict[str, Ban]]:
    """Return what is banned in a folder: words, and whole names."""
    bans = [ban for ban in BANS if ban.applies_to(folder)]
    return {word: ban for ban in bans for word in ban.words}, {
        name: ban for ban in bans for name in ban.whole
    }


@cache
def whole_names_of(folder: str) -> re.Pattern[str]:
    return re.compile(rf"\b_*(?:{'|'.join(map(re.escape, bans_of(folder)[1]))})_*\b")


def may_hold_a_banned_name(folder: str, path: str, text: str) -> bool:
    """Parsing all files takes seconds, and most hold no banned word, not even in their prose."""
    text = f"{Path(path).stem}\n{text}"
    small = text.lower()
    return any(word in small for word in bans_of(folder)[0]) or bool(whole_names_of(folder).search(text))


@cache
def words_of(name: str) -> tuple[str, ...]:
    return tuple(word.lower() for word in _WORD.findall(name))


def faults_of(path: str, text: str) -> list[str]:
    """Return what is wrong with the names of a file, one line each."""
    folder = path.rpartition("/")[0]
    if not may_hold_a_banned_name(folder, path, text):
        return []
    words, whole = bans_of(folder)
    faults = []
    for name in names_of(path, text):
        found = [whole.get(name.text.strip("_")), *map(words.get, words_of(name.text))]
        for ban in filter(None, found):
            if name.kind in ban.kinds and (path, name.text) not in KEPT:
                place = f"{path}:{name.line}: {name.kind.value} {name.text!r}"
                faults.append(f"{place} ({ban.meaning}); use: {ban.use}")
    return faults


@pytest.mark.slow
@pytest.mark.parametrize("tree", TREES)
def test_no_banned_name_is_defined(tree: str) -> None:
    assert files(tree)
    faults = [
        fault for file in files(tree) for fault in faults_of(file.relative_to(ROOT).as_posix(), text_of(file))
    ]
    assert not faults, "\n".join(faults)


def test_every_kept_name_is_still_defined() -> None:
    """An exception that nothing needs any more is removed from the list."""
    for path, text in KEPT:
        assert text in {name.text for name in names_of(path, (ROOT / path).read_text())}, (path, text)


@pytest.mark.parametrize(
    ("path", "text", "expected"),
    [
        ("rce_container/a.py", "class Nursery: ...", "rce_container/a.py:1: class 'Nursery' (the process"),
        ("rce_container/a.py", "x = 1\nnode_nursery_pid = 2", "a.py:2: variable 'node_nursery_pid'"),
        ("rce_container/a.py", "class Cell: ...", "use: ControlGroup"),
        ("rce_container/a.py", "class Unit: ...", "use: Incarnation"),
        ("rce_container/a.py", "def rock(self): ...", "function 'rock'"),
        ("rce_master/a.py", "class Operator: ...", "use: DialProxy"),
        ("rce_client/a.py", "def f(wished): ...", "variable 'wished'"),
        ("rce_client/a.py", "self.parcel = 1", "variable 'parcel'"),
        ("rce_client/a.py", "import x as courier", "variable 'courier'"),
        ("rce_client/a.py", "match x:\n    case [taker]: ...", "a.py:2: variable 'taker'"),
        ("rce_client/a.py", "try: ...\nexcept E as happening: ...", "a.py:2: variable 'happening'"),
        ("rce_fleet/demo/a.py", "def roam(): ...", "use: RandomGoals"),
        ("rce_fleet/station/door.py", "", "door.py:1: module 'door'"),
        ("rce_master/a.py", "def bundle_of(x): ...", "use: package"),
        ("rce/ros/actions/a.py", "patience = 10.0", "use: timeout"),
        ("rce/link/a.py", "self._max_strangers = 1", "use: unauthenticated"),
    ],
)
def test_planted_name_is_reported(path: str, text: str, expected: str) -> None:
    (fault,) = faults_of(path, text)
    assert expected in fault


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("rce_fleet/planning/a.py", "class Cell: ...\ncell = 1"),
        ("rce/services/a.py", "class Unit: ..."),
        ("rce_fleet/a.py", "class Operator: ..."),
        ("rce_container/a.py", "operator = 1\nrocket = 2\nbearing = 3\nunited = 4"),
        ("rce_container/a.py", "seats_left = 'nursery'  # the nursery"),
        ("tests/unit/master/a.py", "class Door: ..."),
    ],
)
def test_other_meaning_of_a_name_is_allowed(path: str, text: str) -> None:
    assert faults_of(path, text) == []
