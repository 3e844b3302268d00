"""Commands on bearer tokens."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce_master.exceptions import ConflictError, LimitReachedError, NotFoundError
from rce_master.state import robots

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import AddToken, NoteTokenUses, RemoveToken, RevokeRobotToken, RevokeToken
    from rce_master.state.user_records import Token


def add(tx: Transaction, command: AddToken) -> None:
    """Keep a token; remove expired ones, and the oldest login beyond the limit."""
    token = command.token
    user = tx.tables.users.get(token.user)
    if user is None:
        raise NotFoundError(f"there is no user {token.user!r}")
    if command.password and command.password != user.password:
        raise ConflictError("the password was changed meanwhile; log in with the new one")
    for old in tx.tables.tokens.by("user", token.user):
        if old.is_expired(token.created):
            forget(tx, old, "the token expired")
    if token.scope:
        _check_scoped(tx, token, replaces=command.replaces)
    else:
        _make_room(tx, token.user)
    tx.put(token)


def note_uses(tx: Transaction, command: NoteTokenUses) -> None:
    """Note when tokens were last used."""
    for digest, used in command.used.items():
        token = tx.tables.tokens.get(digest)
        if token is not None:
            tx.put(replace(token, used=used))


def remove(tx: Transaction, command: RemoveToken) -> None:
    """Remove a token that its owner revokes."""
    token = tx.tables.tokens.get(command.digest)
    if token is None:
        raise NotFoundError("there is no such token")
    forget(tx, token, "logged out")


def revoke(tx: Transaction, command: RevokeToken) -> None:
    """Remove a token by its id, and end the session that uses it."""
    found = [t for t in tx.tables.tokens.by("user", command.user) if t.id == command.id]
    if not found:
        raise NotFoundError(
            f"user {command.user!r} has no token {command.id!r}; list them with: rce token list"
        )
    for token in found:
        forget(tx, token, "the token was revoked")
        tx.happen("token_revoked", f"{token.user}/{token.id}", token.label)


def revoke_robot(tx: Transaction, command: RevokeRobotToken) -> None:
    """Remove the token of a robot, and end the robot's session."""
    user, robot = command.user, command.robot
    found = [t for t in tx.tables.tokens.by("user", user) if t.robot == robot]
    if not found:
        raise NotFoundError(f"robot {robot!r} of user {user!r} has no token; list them with: rce robot list")
    for token in found:
        forget(tx, token, "the robot's token was revoked")
        tx.happen("token_revoked", f"{user}/{robot}", "of the robot")


def forget(tx: Transaction, token: Token, reason: str) -> None:
    """Remove a token, and disconnect the robot that uses it."""
    tx.delete(tx.tables.tokens, token.digest)
    robot = tx.tables.robot(f"{token.user}/{token.robot}") if token.robot else None
    if robot is not None and robot.credential == token.digest:
        robots.send_away(tx, robot, reason)


def _check_scoped(tx: Transaction, token: Token, *, replaces: bool) -> None:
    """See that there is room for a token that is good for one thing only: it is never pushed out."""
    others = [t for t in tx.tables.tokens.by("user", token.user) if t.scope]
    same = [t for t in others if token.robot and t.scope == token.scope]
    if same and not replaces:
        raise ConflictError(
            f"robot {token.robot!r} has a token already; revoke it first (rce robot revoke {token.robot})"
            " or replace it (rce robot add --replace)"
        )
    for old in same:
        forget(tx, old, "the robot's token was replaced")
    if len(others) - len(same) >= tx.settings.max_robots:
        raise LimitReachedError(
            f"user {token.user!r} has {tx.settings.max_robots} tokens of robots and programs already;"
            " revoke those that nothing uses: rce token revoke ID"
        )


def _make_room(tx: Transaction, user: str) -> None:
    """Forget the logins that were not used for longest, until there is room for one more.

    Refusing the new one instead would lock out the owner of the password, who could not revoke tokens without
    a login.
    """
    logins = [t for t in tx.tables.tokens.by("user", user) if not t.scope]
    surplus = len(logins) + 1 - tx.settings.max_tokens
    if surplus <= 0:
        return
    for token in sorted(logins, key=lambda t: max(t.used, t.created))[:surplus]:
        forget(tx, token, "the user logged in too often")
        tx.happen(
            "token_dropped",
            f"{user}/{token.id}",
            f"{token.label or 'no label'}: not used for longest of {tx.settings.max_tokens} logins",
        )
