"""Commands on users."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.model import is_name
from rce_master.exceptions import ConflictError, InvalidRequestError, NotFoundError
from rce_master.state import answers, endpoints, limits, packages, robots, tokens, volumes
from rce_master.state.changes import USER_ADDED, USER_REMOVED
from rce_master.state.user_records import User, UserRole

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import AddUser, RememberLogin, RemoveUser, SetPassword, SetRole


def add_user(tx: Transaction, command: AddUser) -> None:
    """Make a user."""
    user = command.user
    if not is_name(user.name):
        raise InvalidRequestError(
            f"{user.name!r} is not a user name: use letters, digits and '_', a letter first"
        )
    if user.name in tx.tables.users:
        raise ConflictError(f"there is a user {user.name!r} already")
    tx.put(user)
    tx.happen(USER_ADDED, user.name, user.role.value, user="")


def set_password(tx: Transaction, command: SetPassword) -> None:
    """Change a password; end the user's logins, and the sessions of robots that came in by the password.

    Those sessions can do nothing from now on; how many of them a command ends is limited. Tokens of robots
    and of programs stay: they make the fleet independent of the password.
    """
    user = _find(tx, command.name)
    if command.former and command.former != user.password:
        raise ConflictError("the password was changed meanwhile; log in with the new one")
    tx.put(replace(user, password=command.password, password_epoch=endpoints.new_epoch(tx)))
    _forget_login(tx, user.name)
    for token in tx.tables.tokens.by("user", user.name):
        if not token.scope:
            tokens.forget(tx, token, "the password was changed")
    tx.happen("user_password_changed", user.name, user=user.name)
    robots.lock_out(tx, user.name)


def set_role(tx: Transaction, command: SetRole) -> None:
    """Change a user's role. Robots of a user who becomes read-only are disconnected."""
    user = _find(tx, command.name)
    if user.role is command.role:
        return
    _keep_an_admin(tx, user)
    tx.put(replace(user, role=command.role))
    tx.happen("user_role_changed", user.name, command.role.value, user=user.name)
    if not command.role.changes:
        robots.lock_out(tx, user.name)


def remove_user(tx: Transaction, command: RemoveUser) -> None:
    """Remove a user with all robots, containers, packages, volumes and tokens; the user itself at last."""
    user = _find(tx, command.name)
    _keep_an_admin(tx, user)
    _forget_login(tx, user.name)
    for token in tx.tables.tokens.by("user", user.name):
        tokens.forget(tx, token, "the user was removed")
    for endpoint in tx.tables.endpoints.by("user", user.name):
        if tx.is_out_of_work():
            return
        tx.spend(endpoints.removal_work(tx.tables, endpoint.id))
        endpoints.remove(tx, endpoint.id, "the user was removed")
    packages.forget_user(tx, user.name)
    volumes.forget_user(tx, user.name)
    limits.forget(tx, user.name)
    answers.forget_user(tx, user.name)
    tx.delete(tx.tables.users, user.name)
    tx.happen(USER_REMOVED, user.name, user="")


def remember_login(tx: Transaction, command: RememberLogin) -> None:
    """Keep the mark of a correct password, if the user still exists."""
    login = command.login
    if login.user in tx.tables.users and tx.tables.known_logins.get(login.user) != login:
        tx.put(login)


def _find(tx: Transaction, name: str) -> User:
    user = tx.tables.users.get(name)
    if user is None:
        raise NotFoundError(f"there is no user {name!r}")
    return user


def _forget_login(tx: Transaction, user: str) -> None:
    if user in tx.tables.known_logins:
        tx.delete(tx.tables.known_logins, user)


def _keep_an_admin(tx: Transaction, user: User) -> None:
    if [u for u in tx.tables.users if u.role is UserRole.ADMIN] == [user]:
        raise ConflictError(f"{user.name!r} is the last administrator; make another one first")
