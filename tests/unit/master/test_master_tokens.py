from __future__ import annotations

import pytest
from support.master_world import World

from rce_master.exceptions import (
    ConflictError,
    ForbiddenError,
    LimitReachedError,
    NotFoundError,
    WrongCredentialsError,
)
from rce_master.state import commands
from rce_master.state.settings import StateSettings
from rce_master.state.user_records import User, UserRole
from rce_master.tokens import TOKEN_LIFETIME_S, Tokens, new_token


class Issuer:
    """Tokens of anna, with a clock in the test's hand."""

    def __init__(self, settings: StateSettings | None = None) -> None:
        self.world = World(settings)
        self.now = 100.0
        self.tokens = Tokens(self.world.state.tables, lambda: self.now)

    def add(self, scope: str = "", lifetime: float = TOKEN_LIFETIME_S, *, replaces: bool = False) -> str:
        token, record = new_token("anna", "test", self.now, lifetime, scope=scope)
        self.world.do(self.tokens.uses())
        self.world.do(commands.AddToken(token=record, replaces=replaces))
        return token

    def is_good(self, token: str) -> bool:
        try:
            return self.tokens.find(token)[0].name == "anna"
        except WrongCredentialsError:
            return False

    def digest(self, token: str) -> str:
        return self.tokens.find(token)[1].digest


def test_uses_of_one_user_leave_those_of_others() -> None:
    """A login writes the times of its own user only."""
    issuer = Issuer()
    bert = User(name="bert", role=UserRole.USER, password="", created=0.0)
    issuer.world.do(commands.AddUser(user=bert))
    of_bert, record = new_token("bert", "test", issuer.now)
    issuer.world.do(commands.AddToken(token=record))
    of_anna = issuer.add()
    assert [issuer.tokens.find(token)[0].name for token in (of_anna, of_bert)] == ["anna", "bert"]
    assert issuer.tokens.uses_of("anna").used == {issuer.digest(of_anna): issuer.now}
    assert set(issuer.tokens.uses().used) == {record.digest, issuer.digest(of_anna)}


def test_token_kept_as_digest_and_expires() -> None:
    issuer = Issuer()
    token = issuer.add()
    assert token not in str(list(issuer.world.state.tables.tokens))
    assert issuer.is_good(token)
    assert not issuer.is_good("rce_guess")
    assert not issuer.is_good("rce_\udce9")
    issuer.now += TOKEN_LIFETIME_S
    assert not issuer.is_good(token)


def test_token_without_lifetime_never_expires() -> None:
    issuer = Issuer()
    token = issuer.add("robot:R1", 0.0)
    issuer.now += 1e10
    assert issuer.is_good(token)


def test_login_too_many_drops_least_recently_used() -> None:
    """A login is never refused for the number of logins, and what is in use stays."""
    issuer = Issuer(StateSettings(max_tokens=3))
    given = []
    for _ in range(3):
        issuer.now += 1
        given.append(issuer.add())
    robot = issuer.add("robot:R1", 0.0)
    issuer.now += 1
    assert issuer.is_good(given[0])  # used now, though it is the oldest
    issuer.now += 1
    new = issuer.add()
    assert [issuer.is_good(token) for token in (*given, new, robot)] == [True, False, True, True, True]


def test_store_with_thousands_of_tokens_shrinks_at_next_login() -> None:
    issuer = Issuer(StateSettings(max_tokens=5000))
    for _ in range(300):
        issuer.add()
    issuer.world.state.settings = StateSettings(max_tokens=10)
    issuer.add()
    assert issuer.world.state.tables.tokens.count("user", "anna") == 10


def test_expired_tokens_leave_at_next_login() -> None:
    issuer = Issuer()
    issuer.add()
    issuer.now += TOKEN_LIFETIME_S
    new = issuer.add()
    assert [t.digest for t in issuer.world.state.tables.tokens] == [issuer.digest(new)]


def test_password_change_ends_logins_not_robots_tokens() -> None:
    issuer = Issuer()
    login, robot = issuer.add(), issuer.add("robot:R1", 0.0)
    issuer.world.do(commands.SetPassword(name="anna", password="y"))
    assert (issuer.is_good(login), issuer.is_good(robot)) == (False, True)


def test_change_by_an_already_changed_password_is_refused() -> None:
    world = Issuer().world
    world.do(commands.SetPassword(name="anna", password="y", former="x"))
    with pytest.raises(ConflictError, match="password was changed"):
        world.do(commands.SetPassword(name="anna", password="z", former="x"))
    assert world.state.tables.users["anna"].password == "y"


def test_login_with_password_changed_meanwhile_is_refused() -> None:
    issuer = Issuer()
    _, record = new_token("anna", "", 0.0)
    issuer.world.do(commands.SetPassword(name="anna", password="y"))
    with pytest.raises(ConflictError, match="password was changed"):
        issuer.world.do(commands.AddToken(token=record, password="x"))
    issuer.world.robot_set()
    with pytest.raises(ForbiddenError, match="password was changed"):
        issuer.world.do(commands.RobotLogin(process="r1", id="anna/rob", password="x"))


def test_second_token_of_robot_needs_replace() -> None:
    issuer = Issuer()
    first = issuer.add("robot:R1")
    with pytest.raises(ConflictError, match="rce robot revoke R1"):
        issuer.add("robot:R1")
    second = issuer.add("robot:R1", replaces=True)
    assert (issuer.is_good(first), issuer.is_good(second)) == (False, True)


def test_robot_tokens_are_limited_and_stay() -> None:
    issuer = Issuer(StateSettings(max_robots=2))
    kept = [issuer.add(f"robot:R{number}") for number in range(2)]
    with pytest.raises(LimitReachedError, match="2 tokens"):
        issuer.add("robot:R3")
    assert all(map(issuer.is_good, kept))


def test_revoked_robot_token_sends_away_its_session_only() -> None:
    issuer = Issuer()
    world = issuer.world
    world.robot_set()
    digest = issuer.digest(issuer.add("robot:R1"))
    world.do(commands.RobotLogin(process="r1", id="anna/R1", credential=digest))
    world.login("other")
    changes = world.do(commands.RevokeRobotToken(user="anna", robot="R1"))
    assert [(w.id, w.reason) for w in changes.withdrawals] == [("anna/R1", "the robot's token was revoked")]
    assert (world.session("R1"), world.session("other")) == ("absent", "connected")
    with pytest.raises(ForbiddenError, match="revoked"):
        world.do(commands.RobotLogin(process="r1", id="anna/R1", credential=digest))
    with pytest.raises(NotFoundError, match="rce robot list"):
        world.do(commands.RevokeRobotToken(user="anna", robot="R1"))


def test_password_change_spares_robot_with_token() -> None:
    issuer = Issuer()
    world = issuer.world
    world.robot_set()
    digest = issuer.digest(issuer.add("robot:R1"))
    world.do(commands.RobotLogin(process="r1", id="anna/R1", credential=digest))
    world.login("other")
    changes = world.do(commands.SetPassword(name="anna", password="y"))
    assert [w.id for w in changes.withdrawals] == ["anna/other"]


def test_revoke_by_id_is_of_the_user_only() -> None:
    issuer = Issuer()
    issuer.world.user("bob")
    token = issuer.add()
    id_ = issuer.tokens.find(token)[1].id
    with pytest.raises(NotFoundError, match="rce token list"):
        issuer.world.do(commands.RevokeToken(user="bob", id=id_))
    issuer.world.do(commands.RevokeToken(user="anna", id=id_))
    assert not issuer.is_good(token)
