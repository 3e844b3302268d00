"""Who is there, by heartbeats and by silence."""

from __future__ import annotations

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rce.ros.multimaster.heartbeat import Heartbeat, Kind, Stamp
from rce.ros.multimaster.peer_table import (
    MAX_PEERS,
    Contact,
    LivenessSettings,
    PeerChange,
    PeerKey,
    PeerTable,
    Step,
)

HOST, PORT = "10.0.0.2", 11611
KEY = PeerKey(HOST, PORT)
CONTACT = Contact("http://10.0.0.2:11311/", "robot", "/master_discovery")


def beat(secs: int = 1, *, rate: float = 1.0, kind: Kind = Kind.STATE, local: int = 1) -> Heartbeat:
    return Heartbeat(kind, PORT, rate, Stamp(secs, 0), Stamp(local, 0))


def known(**liveness: float) -> PeerTable:
    found = PeerTable(LivenessSettings(**liveness))
    assert found.received(HOST, beat(), 0.0).ask_contact == [KEY]
    step = found.contacted(KEY, CONTACT, 0.0)
    assert changes(step) == [(PeerChange.NEW, True)]
    return found


def changes(step: Step) -> list[tuple[PeerChange, bool]]:
    return [(event.change, event.master.online) for event in step.events]


def test_a_master_is_told_of_once_it_said_its_name() -> None:
    found = PeerTable()
    assert found.received(HOST, beat(), 0.0).events == []
    assert found.masters == []
    found.contacted(KEY, CONTACT, 0.1)
    (master,) = found.masters
    assert (master.name, master.uri, master.monitor_uri) == (
        "robot",
        "http://10.0.0.2:11311/",
        "http://10.0.0.2:11611/",
    )


def test_a_name_that_is_not_answered_is_asked_for_again() -> None:
    found = PeerTable()
    found.received(HOST, beat(), 0.0)
    assert found.tick(1.0).ask_contact == []
    assert found.tick(2.0).ask_contact == [KEY]


def test_a_new_stamp_is_a_change_and_an_old_one_is_not() -> None:
    found = known()
    assert found.received(HOST, beat(1), 1.0).events == []
    assert changes(found.received(HOST, beat(2), 2.0)) == [(PeerChange.CHANGED, True)]
    assert changes(found.received(HOST, beat(2, local=2), 3.0)) == [(PeerChange.CHANGED, True)]


def test_by_default_a_loss_is_noticed_within_three_heartbeats() -> None:
    found = known()
    found.received(HOST, beat(), 10.0)
    assert found.tick(12.4).events == []
    assert changes(found.tick(13.0)) == [(PeerChange.CHANGED, False)]
    assert found.tick(14.0).events == []


def test_who_comes_back_must_say_its_name_again() -> None:
    found = known()
    found.tick(5.0)
    step = found.received(HOST, beat(), 6.0)
    assert (step.events, step.ask_contact) == ([], [KEY])
    assert changes(found.contacted(KEY, CONTACT, 6.1)) == [(PeerChange.CHANGED, True)]


def test_another_master_in_the_place_of_one_that_was_lost() -> None:
    found = known()
    found.tick(5.0)
    found.received(HOST, beat(), 6.0)
    step = found.contacted(KEY, CONTACT._replace(master_name="other"), 6.1)
    assert [(event.change, event.master.name) for event in step.events] == [
        (PeerChange.REMOVED, "robot"),
        (PeerChange.NEW, "other"),
    ]


def test_who_leaves_is_removed_at_once() -> None:
    found = known()
    assert changes(found.received(HOST, beat(kind=Kind.LEAVING), 1.0)) == [(PeerChange.REMOVED, False)]
    assert found.masters == []
    assert found.received(HOST, beat(kind=Kind.LEAVING), 1.0).events == []


def test_a_lost_master_is_forgotten_later() -> None:
    found = known(remove_after=100)
    found.tick(50.0)
    assert len(found.masters) == 1
    assert changes(found.tick(101.0)) == [(PeerChange.REMOVED, False)]


def test_rare_heartbeats_lead_to_questions_and_then_to_a_loss() -> None:
    found = PeerTable()
    found.received(HOST, beat(rate=0.0), 0.0)
    found.contacted(KEY, CONTACT, 0.0)
    assert found.tick(60.0).request_state == []
    asked = [second for second in range(61, 80) if found.tick(float(second)).request_state]
    assert asked == [61, 62, 63, 64, 65]
    assert [master.online for master in found.masters] == [False]


def test_an_answer_ends_the_questions() -> None:
    found = PeerTable()
    found.received(HOST, beat(rate=0.0), 0.0)
    found.contacted(KEY, CONTACT, 0.0)
    assert found.tick(61.0).request_state == [HOST]
    found.received(HOST, beat(rate=0.0), 61.5)
    assert found.tick(62.0).request_state == []
    assert [master.online for master in found.masters] == [True]


def test_the_quality_of_a_link() -> None:
    found = known()
    for second in range(1, 11):
        if second % 2:
            found.received(HOST, beat(), float(second))
    ((name, quality, silence),) = found.links(10.0)
    assert (name, silence) == ("robot", 1.0)
    assert 40 <= quality <= 60


def test_inventing_masters_has_an_end() -> None:
    found = PeerTable()
    for number in range(MAX_PEERS + 10):
        found.received(f"10.1.{number // 256}.{number % 256}", beat(), 0.0)
    assert len(found.hosts) == MAX_PEERS


class Masters(RuleBasedStateMachine):
    """Whatever happens, who counts the events knows who is there and online."""

    def __init__(self) -> None:
        super().__init__()
        self.core = PeerTable(LivenessSettings(remove_after=20))
        self.now = 0.0
        self.believed: dict[str, bool] = {}

    def take(self, step: Step) -> None:
        for event in step.events:
            uri = event.master.monitor_uri
            if event.change is PeerChange.REMOVED:
                del self.believed[uri]
            else:
                assert (event.change is PeerChange.NEW) == (uri not in self.believed)
                self.believed[uri] = event.master.online

    @rule(host=st.sampled_from("abc"), secs=st.integers(1, 3), kind=st.sampled_from(Kind))
    def hear(self, host: str, secs: int, kind: Kind) -> None:
        self.take(self.core.received(host, beat(secs, kind=kind), self.now))

    @rule(host=st.sampled_from("abc"), name=st.sampled_from("xy"))
    def learn(self, host: str, name: str) -> None:
        contact = CONTACT._replace(master_name=name)
        self.take(self.core.contacted(PeerKey(host, PORT), contact, self.now))

    @rule(seconds=st.floats(0.1, 15))
    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.take(self.core.tick(self.now))

    @invariant()
    def believed_is_true(self) -> None:
        assert self.believed == {master.monitor_uri: master.online for master in self.core.masters}


TestMasters = Masters.TestCase
TestMasters.settings = settings(max_examples=50, stateful_step_count=30)
