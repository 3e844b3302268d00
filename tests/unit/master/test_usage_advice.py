"""Rates and advice out of what task sets tell."""

from __future__ import annotations

from typing import TypedDict, Unpack

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.parts import ResourceParts

from rce.control.messages import MachineInfo, Usage
from rce.control.model import EndpointUsage, NodeUsage
from rce.model.specs import Resources
from rce_master.advice import Advice, Movable, Subject, for_container, for_machine
from rce_master.state.placement import Room
from rce_master.usage import STEP_S, WINDOW_S, History, UsageBook

MB = 1 << 20
ID = "anna/c"
LABELLED = Resources(memory=20 * MB, special_features=("gpu",))


class CpuCounters(TypedDict):
    cpu_s: float
    throttled_s: float


class UsageParts(TypedDict, total=False):
    memory: int
    memory_limit: int
    oom_kills: int
    cpu_limit: float


class Watched:
    """A container that reports every two seconds."""

    def __init__(self) -> None:
        self.now = 0.0
        self.book = UsageBook(lambda: self.now)
        self.counters = CpuCounters(cpu_s=0.0, throttled_s=0.0)

    def run(
        self, seconds: float, *, cores: float = 0.0, throttled: float = 0.0, **fields: Unpack[UsageParts]
    ) -> History:
        """Let it run; returns its history."""
        for _ in range(int(seconds / 2)):
            self.now += 2
            self.counters["cpu_s"] += 2 * cores
            self.counters["throttled_s"] += 2 * throttled
            told = EndpointUsage(**self.counters, **fields)
            self.book.note("c1", Usage(cpu_s=1.0, memory=1, endpoints={ID: told}), {ID})
        found = self.book.history("c1", ID)
        assert found is not None
        return found


@pytest.fixture
def watched() -> Watched:
    return Watched()


def texts(found: list[Advice]) -> list[tuple[str, str]]:
    return [(one.about, one.command) for one in found]


def advise(history: History, room: Room | None = None, **requested: Unpack[ResourceParts]) -> list[Advice]:
    return for_container(Subject("c", Resources(**requested)), history, room)


def test_rates_are_those_of_the_last_two_reports(watched: Watched) -> None:
    watched.run(10, cores=1.0)
    history = watched.run(2, cores=0.5, throttled=0.25)
    assert (history.rates.cpu, history.rates.throttled) == (0.5, 0.25)


def test_nodes_have_rates_of_their_own() -> None:
    now = 0.0
    book = UsageBook(lambda: now)
    for now, cpu in ((0.0, 1.0), (2.0, 2.0)):  # noqa: B007 - the clock reads it
        told = EndpointUsage(nodes={"n": NodeUsage(cpu_s=cpu)})
        book.note("c1", Usage(cpu_s=0, memory=0, endpoints={ID: told}), {ID})
    history = book.history("c1", ID)
    assert history is not None
    assert (history.node_cpu("n"), history.node_cpu("other")) == (0.5, 0.0)


def test_a_container_that_was_made_anew_begins_anew(watched: Watched) -> None:
    watched.run(600, cores=1.0)
    watched.counters = CpuCounters(cpu_s=0.0, throttled_s=0.0)
    history = watched.run(4, cores=0.5)
    assert history.rates.cpu == 0.5
    assert len(history.samples) == 2


def test_only_what_is_placed_there_has_a_history(watched: Watched) -> None:
    watched.run(2)
    told = EndpointUsage()
    watched.book.note("c1", Usage(cpu_s=0, memory=0, endpoints={ID: told, "evil/x": told}), set())
    assert watched.book.history("c1", ID) is None
    assert watched.book.history("c1", "evil/x") is None
    watched.book.forget("c1")
    assert watched.book.newest == {}


def test_a_history_stays_small_and_covers_its_window(watched: Watched) -> None:
    history = watched.run(3 * WINDOW_S, memory=5)
    assert len(history.samples) <= WINDOW_S / STEP_S + 1
    assert history.now.time - history.samples[0].time == pytest.approx(WINDOW_S, rel=0.05)


def test_memory_that_ran_out_asks_for_twice_as_much(watched: Watched) -> None:
    history = watched.run(60, memory=50 * MB, memory_limit=256 * MB, oom_kills=2)
    (advice,) = advise(history)
    assert advice == (
        "too small",
        "its memory ran out 2 times lately (limit 256 MB)",
        "rce resize c --memory 512M",
    )
    history = watched.run(WINDOW_S + 60, memory=50 * MB, memory_limit=512 * MB, oom_kills=2)
    assert advise(history) == [], "that was long ago"


def test_memory_that_is_nearly_full_asks_for_half_as_much_again(watched: Watched) -> None:
    assert texts(advise(watched.run(10, memory=95 * MB, memory_limit=100 * MB))) == [
        ("too small", "rce resize c --memory 160M")
    ]
    assert advise(watched.run(10, memory=85 * MB, memory_limit=100 * MB)) == []


def test_a_container_that_is_held_back_asks_for_more_cores(watched: Watched) -> None:
    history = watched.run(60, cores=0.5, throttled=0.4, cpu_limit=0.5)
    (advice,) = advise(history)
    assert advice == (
        "too small",
        "was held back by its limit of 0.5 cores for 40% of the time",
        "rce resize c --cpu 0.7",
    )
    assert advise(Watched().run(60, cores=0.5, throttled=0.05, cpu_limit=0.5)) == []


def test_advice_to_grow_says_when_the_machine_has_no_room(watched: Watched) -> None:
    machine = MachineInfo(name="m1", memory=300 * MB)
    room = Room(process="c1", machine=machine, memory=300 * MB)
    history = watched.run(10, memory=95 * MB, memory_limit=100 * MB)
    (advice,) = advise(history, room, memory=100 * MB)
    assert "its machine has no room for more (m1 has 100 of 300 MB memory free, 160 MB needed)" in advice.text
    full = Room(process="c2", machine=machine, memory=200 * MB)
    empty = Room(process="c3", machine=MachineInfo(name="m3", memory=300 * MB))
    subject = Subject("c", Resources(memory=100 * MB))
    (advice,) = for_container(subject, history, room, [full, room, empty])
    assert "m3 has; an administrator can move it there first" in advice.text
    assert advice.command == "rce move c m3 --wait && rce resize c --memory 160M"
    (advice,) = for_container(subject._replace(user="bob"), history, room, [empty])
    assert advice.command == "rce move c m3 --wait --user bob && rce resize c --memory 160M --user bob"


def test_advice_to_move_names_a_machine_with_the_labels(watched: Watched) -> None:
    machine = MachineInfo(name="m1", memory=300 * MB, labels=("gpu",))
    room = Room(process="c1", machine=machine, memory=300 * MB)
    history = watched.run(10, memory=95 * MB, memory_limit=100 * MB)
    others = [
        Room(process=f"c{n}", machine=MachineInfo(name=f"m{n}", memory=300 * MB, labels=labels))
        for n, labels in ((2, ()), (3, ()), (4, ("gpu",)))
    ]
    subject = Subject("c", Resources(memory=100 * MB, special_features=("gpu",)))
    (advice,) = for_container(subject, history, room, others)
    assert advice.command == "rce move c m4 --wait && rce resize c --memory 160M"


def test_what_is_hardly_used_is_too_large_but_not_at_once(watched: Watched) -> None:
    requested: ResourceParts = {"cpu": 2.0, "memory": 1000 * MB}
    assert advise(watched.run(200, cores=0.1, memory=50 * MB), **requested) == []
    history = watched.run(200, cores=0.1, memory=50 * MB)
    assert texts(advise(history, **requested)) == [
        ("too large", "rce resize c --cpu 0.2"),
        ("too large", "rce resize c --memory 112M"),
    ]
    history = watched.run(10, cores=1.5, memory=900 * MB)
    assert advise(history, **requested) == [], "once is enough"
    watched.run(4, memory=50 * MB)
    assert advise(watched.run(400, memory=50 * MB), **requested) == []


def test_a_container_of_many_slots_that_uses_few_gives_some_back(watched: Watched) -> None:
    history = watched.run(400, cores=0.1, memory=20 * MB, memory_limit=512 * MB)
    assert texts(advise(history, size=8)) == [("too large", "rce resize c --size 1")]
    assert advise(history, size=1) == []


def test_a_machine_that_is_nearly_promised_away_is_too_full() -> None:
    full = Room(process="c1", machine=MachineInfo(name="m1", slots=10, cores=2), slots=10, cpu=0.5)
    empty = Room(process="c2", machine=MachineInfo(name="m2", slots=10))
    (advice,) = for_machine(full, [empty])
    assert advice.text.startswith("100% of its slots are promised; new containers go to m2")
    assert for_machine(full, [])[0].command == "rce-container MASTER_IP"
    assert for_machine(empty, [full]) == []


def movable(tag: str, **requested: Unpack[ResourceParts]) -> Movable:
    return Movable("anna", tag, Resources(**requested))


def test_a_container_is_to_leave_a_machine_that_is_too_full() -> None:
    """The smallest one that leaves enough free, or the one that leaves most."""
    full = Room(process="c1", machine=MachineInfo(name="m1", memory=1000 * MB), memory=960 * MB)
    room = Room(process="c2", machine=MachineInfo(name="m2", memory=1000 * MB), memory=500 * MB)
    containers = [movable("large", memory=390 * MB), movable("enough", memory=70 * MB)]
    few = [movable("tiny", memory=10 * MB), movable("small", memory=30 * MB)]
    assert for_machine(full, [room], [*few, *containers]) == [
        Advice(
            "too full",
            "96% of its memory are promised; m2 has room for anna/enough, and is 57% full with it"
            " (what its nodes hold in memory only is lost)",
            "rce move enough m2 --user anna",
        )
    ]
    (advice,) = for_machine(full, [room], few)
    assert advice.command == "rce move small m2 --user anna"


def test_no_move_is_advised_that_only_shifts_the_problem() -> None:
    full = Room(process="c1", machine=MachineInfo(name="m1", memory=1000 * MB), memory=960 * MB)
    other = Room(process="c2", machine=MachineInfo(name="m2", memory=1000 * MB), memory=850 * MB)
    drained = Room(process="c3", machine=MachineInfo(name="m3", memory=1000 * MB), draining=True)
    containers = [movable("enough", memory=70 * MB), Movable("anna", "labelled", LABELLED)]
    (advice,) = for_machine(full, [other, drained], containers)
    assert advice.command == "rce top --sort memory"
    slots = Room(process="c1", machine=MachineInfo(name="m1", slots=10, memory=1000 * MB), slots=10)
    room = Room(process="c2", machine=MachineInfo(name="m2", slots=10))
    (advice,) = for_machine(slots, [room], [movable("one", size=2)])
    assert advice.command == "rce move one m2 --user anna"


@given(
    st.lists(
        st.tuples(
            st.floats(0, 4),
            st.floats(0, 1),
            st.integers(0, 1 << 33),
            st.integers(0, 1 << 33),
            st.integers(0, 3),
        ),
        min_size=1,
        max_size=40,
    ),
    st.builds(Resources, size=st.integers(1, 9), cpu=st.floats(0, 8), memory=st.integers(0, 1 << 33)),
)
def test_advice_is_about_one_direction_of_each_thing(
    reports: list[tuple[float, float, int, int, int]], requested: Resources
) -> None:
    watched = Watched()
    for cores, throttled, memory, limit, kills in reports:
        history = watched.run(
            30,
            cores=cores,
            throttled=throttled,
            memory=memory,
            memory_limit=limit,
            oom_kills=kills,
            cpu_limit=requested.cpu,
        )
    found = for_container(Subject("c", requested), history, None)
    assert all(one.command.startswith("rce resize c --") and one.text for one in found)
    assert len({one.command.split()[3] for one in found if one.about == "too small"}) == sum(
        one.about == "too small" for one in found
    )
