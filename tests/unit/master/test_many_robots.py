"""Sessions of many robots that end or come back at once: in slices, as if each had done so with the first."""

from __future__ import annotations

import pytest
from support.master_cloud import Cloud
from support.master_world import World, restarted
from support.state_reports import kinds, status

from rce.control.messages import CONTROL_VERSION, Drop, Hello, MachineInfo, Status, TaskSetKind
from rce_master.exceptions import ConflictError
from rce_master.state import commands, task_sets
from rce_master.state.changes import Changes
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import Token, UserRole

ROBOTS = 60
NEW_PASSWORD = commands.SetPassword(name="anna", password="new")


@pytest.fixture
def fleet() -> World:
    """Many robots, of which a command ends some only."""
    world = World(StateSettings(max_work=1000))
    world.robot_set()
    for number in range(ROBOTS):
        world.login(f"rob{number}")
    return world


def slices(world: World, command: commands.Command) -> list[Changes]:
    """Do a command and what it leaves over."""
    done = [world.do(command)]
    while done[-1].unfinished:
        done.append(world.do(commands.Continue()))
    return done


def dropped(changes: Changes) -> list[str]:
    return [drop.id for drop in changes.withdrawals]


def sessions(world: World) -> list[str]:
    return [world.session(robot.tag) for robot in world.state.tables.robots("anna")]


@pytest.mark.parametrize(
    "command", [NEW_PASSWORD, commands.SetRole(name="anna", role=UserRole.VIEWER)], ids=["password", "role"]
)
def test_sessions_of_a_user_end_in_slices(fleet: World, command: commands.Command) -> None:
    """None of the commands does more than its share, and each robot is sent away once."""
    done = slices(fleet, command)
    assert max(len(changes.withdrawals) for changes in done) < ROBOTS / 2
    assert sorted(id_ for one in done for id_ in dropped(one)) == sorted(
        robot.id for robot in fleet.state.tables.robots("anna")
    )
    assert sessions(fleet) == ["absent"] * ROBOTS
    assert not fleet.state.tables.lockouts


def test_sessions_of_a_lost_task_set_end_in_slices(fleet: World) -> None:
    for number in range(ROBOTS):
        fleet.report("r1", status(f"rob{number}", interfaces=dict.fromkeys("abcdefgh", True)))
    left = [
        kinds(changes).count("robot_left") for changes in slices(fleet, commands.TaskSetLeft(process="r1"))
    ]
    assert max(left) < ROBOTS
    assert sum(left) == ROBOTS
    assert sessions(fleet) == ["absent"] * ROBOTS
    assert not fleet.state.tables.active


@pytest.mark.parametrize("process", ["r1", "r2"])
def test_a_locked_out_robot_can_log_in_again_at_once(fleet: World, process: str) -> None:
    """Its turn has not come yet; the new session is not sent away later."""
    fleet.robot_set("r2")
    last = f"rob{ROBOTS - 1}"
    assert f"anna/{last}" not in dropped(fleet.do(NEW_PASSWORD))
    assert dropped(fleet.login(last, process)) == [f"anna/{last}"]
    later = [id_ for one in slices(fleet, commands.Continue()) for id_ in dropped(one)]
    assert len(later) == len(set(later))
    assert f"anna/{last}" not in later
    assert fleet.session(last) == "connected"


def test_a_lost_robot_can_log_in_elsewhere_at_once(fleet: World) -> None:
    fleet.robot_set("r2")
    fleet.state.apply(commands.TaskSetLeft(process="r1"), fleet.now, max_work=1)
    last = f"rob{ROBOTS - 1}"
    assert fleet.session(last) == "connected", "its turn has not come yet"
    fleet.login(last, "r2")
    slices(fleet, commands.Continue())
    assert sessions(fleet) == ["absent"] * (ROBOTS - 1) + ["connected"]


def test_a_task_set_that_is_back_keeps_robots_not_left_yet(fleet: World) -> None:
    fleet.state.apply(commands.TaskSetLeft(process="r1"), fleet.now, max_work=1)
    fleet.robot_set(endpoints=tuple(status(f"rob{number}") for number in range(1, ROBOTS)))
    slices(fleet, commands.Continue())
    assert sessions(fleet) == ["absent"] + ["connected"] * (ROBOTS - 1)


def test_a_restarted_master_ends_sessions_that_it_hears_of(fleet: World) -> None:
    """What the former master had no time for is not forgotten."""
    gone = set(dropped(fleet.do(NEW_PASSWORD)))
    world = restarted(fleet)
    there = tuple(status(f"rob{number}") for number in range(ROBOTS))
    world.robot_set(endpoints=there)
    assert sessions(world) == ["absent"] * ROBOTS
    assert not [robot for robot in world.state.tables.robots("anna") if robot.task_set]
    assert gone < {one.id for one in there}


def test_a_report_of_a_locked_out_robot_ends_its_session(fleet: World) -> None:
    last = f"rob{ROBOTS - 1}"
    fleet.do(NEW_PASSWORD)
    changes = fleet.report("r1", status(last, interfaces={"a": True}))
    assert dropped(changes) == [f"anna/{last}"]
    assert not fleet.state.tables.active


def test_a_robot_of_a_token_that_uses_the_new_password_stays(world: World) -> None:
    """It came in by its token when the password was changed, and by the new password since."""
    world.wired()
    token = "t" * 64
    world.do(commands.RobotLeft(process="r1", id="anna/rob"))
    record = Token(digest=token, user="anna", label="", created=0.0, expires=0.0, scope="robot:rob")
    world.do(commands.AddToken(token=record))
    world.do(commands.RobotLogin(process="r1", id="anna/rob", credential=token))
    assert dropped(world.do(NEW_PASSWORD)) == []
    world.do(commands.RobotLeft(process="r1", id="anna/rob"))
    world.login()
    assert world.session() == "connected"
    with pytest.raises(ConflictError, match="connected already"):
        world.login()


async def test_many_robots_of_a_task_set_come_back_in_slices(cloud: Cloud) -> None:
    parts = dict.fromkeys((f"i{number}" for number in range(100)), True)
    there = [status(f"rob{number}", interfaces=parts) for number in range(ROBOTS)]
    robots = cloud.robots()
    await robots.hello()
    for one in (*there, status("lost")):
        await cloud.state_service.submit(commands.RobotLogin(process="r1", id=one.id))
        await robots.say(Status(status=one))
    await cloud.control_handler.on_gone(robots)
    back: list[int] = []
    cloud.state_service.listeners.append(lambda changes: back.append(kinds(changes).count("robot_connected")))
    sync = await cloud.robots().hello(*there)
    assert len(sync.endpoints) == ROBOTS + 1
    assert max(back) < ROBOTS / 2
    assert sum(back) == ROBOTS
    tables = cloud.state_service.tables
    found = [tables.robot_live(robot.id).session.value for robot in tables.robots("anna")]
    assert found == ["connected"] * ROBOTS + ["absent"]
    assert len(tables.active) == ROBOTS * len(parts)


def test_a_refused_task_set_brings_no_robots(world: World) -> None:
    world.wired()
    world.run()
    found = status("c", interfaces=dict.fromkeys((f"i{number}" for number in range(3000)), True))
    hello = Hello(
        version=CONTROL_VERSION,
        kind=TaskSetKind.ROBOT,
        process="c1",
        machine=MachineInfo(name="m"),
        endpoints=(found, found),
    )
    first, *rest = task_sets.arrival(hello)
    assert len(rest) == 2
    with pytest.raises(ConflictError, match="container task set 'c1' already"):
        world.do(first)
    for command in rest:
        world.do(command)
    assert not world.state.tables.active


async def test_a_locked_out_robot_asks_for_nothing(cloud: Cloud) -> None:
    """Its session ends some commands later, and its requests are refused from the first on."""
    robots = cloud.robots()
    await robots.hello()
    for robot in ("first", "last"):
        assert (await robots.login(robot)).status == 200
    state = cloud.state_service.state
    assert state.apply(NEW_PASSWORD, 0.0, max_work=1).unfinished
    assert await robots.ask("CC", {"containerTag": "c"}, robot="last") == ("the password was changed",)
    assert not state.tables.containers("anna")
    await cloud.flush()
    assert (await robots.get(Drop)).id == "anna/last"
