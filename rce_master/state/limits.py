"""The limits of one user, and their usage: containers, requested resources, packages."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from msgspec.structs import asdict, replace

from rce.model import MEGABYTE, write_cores
from rce_master.exceptions import LimitReachedError, NotFoundError
from rce_master.state.user_records import UserLimits, UserRole

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import SetLimits
    from rce_master.state.promises import Promise
    from rce_master.state.settings import StateSettings
    from rce_master.state.tables import Tables

KINDS = ("containers", "slots", "cpu", "memory", "packages", "disk")
_OF_MACHINES = ("slots", "cpu", "memory")
_UNITS = {"cpu": "cores", "memory": "MB of memory"}
_EPSILON = 1e-6


class Limit(NamedTuple):
    """How much of a kind a user may have. Memory and disk are in bytes."""

    kind: str
    most: float
    """0: no limit."""
    source: str
    """``user``: set for this one; ``role``: for all of this role; ``all``: for all users; ``machines``: a
    share of what the machines have."""


def set_limits(tx: Transaction, command: SetLimits) -> None:
    """Change a user's limits; existing objects stay."""
    if command.user not in tx.tables.users:
        raise NotFoundError(f"there is no user {command.user!r}")
    there = tx.tables.user_limits.get(command.user) or UserLimits(user=command.user)
    tx.put(replace(there, **command.limits))
    told = ", ".join(
        f"{kind} {'as for all' if most is None else most}" for kind, most in command.limits.items()
    )
    tx.happen("user_limits_changed", command.user, told, user=command.user)


def forget(tx: Transaction, user: str) -> None:
    """Remove the limits that were set for a user."""
    if user in tx.tables.user_limits:
        tx.delete(tx.tables.user_limits, user)


def limit_of(tables: Tables, settings: StateSettings, user: str, kind: str) -> Limit:
    """Return a user's limit of a kind."""
    own = tables.user_limits.get(user)
    if own is not None and (most := asdict(own)[kind]) is not None:
        return Limit(kind, most, "user")
    if tables.users[user].role is UserRole.ADMIN and kind not in ("packages", "disk"):
        return Limit(kind, 0, "role")
    most = getattr(settings, _SETTINGS[kind])
    share = settings.user_share * _offered(tables, kind) if kind in _OF_MACHINES else 0
    if share and (not most or share < most):
        return Limit(kind, max(1, int(share)) if kind == "slots" else share, "machines")
    return Limit(kind, most, "all")


def used_of(tables: Tables, user: str) -> dict[str, float]:
    """Return a user's usage of each kind."""
    requested = tables.requested.sum_of(user)
    packages = tables.packages.by("user", user)
    return {
        "containers": requested.containers,
        **{kind: _asked(requested, kind) for kind in _OF_MACHINES},
        "packages": len(packages),
        "disk": sum(package.size for package in packages)
        + sum(disk_of(volume.size, volume.snapshots) for volume in tables.volumes.by("user", user))
        + tables.saved_states.total(user),
    }


def disk_of(size: int, snapshots: int) -> int:
    """Return how many bytes of disk a volume counts as: one with snapshots is at the masters, too."""
    return 2 * size if snapshots else size


def check_containers(tx: Transaction, user: str) -> None:
    """Check that a user may have one more container.

    Raises:
        LimitReachedError: The limit is reached.
    """
    limit = limit_of(tx.tables, tx.settings, user, "containers")
    if limit.most and tx.tables.endpoints.count("containers_of", user) >= limit.most:
        raise LimitReachedError(
            f"you have {limit.most:g} containers already; destroy one first, or {_advice(user, 'containers')}"
        )


def check_all_resources(tx: Transaction, user: str, before: Promise, total: Promise) -> None:
    """Check the total of the requests of a user's containers, as far as it grows.

    A limit may be smaller than what a user has: it was changed, or a machine is gone.

    Args:
        tx: The transaction.
        user: The user.
        before: The total without the request.
        total: The total with it.

    Raises:
        LimitReachedError: It exceeds a limit.
    """
    for kind in _OF_MACHINES:
        asked = _asked(total, kind)
        if asked <= _asked(before, kind):
            continue
        limit = limit_of(tx.tables, tx.settings, user, kind)
        if limit.most and asked > limit.most + _EPSILON:
            share = (
                f", {tx.settings.user_share:.0%} of what the machines have"
                if limit.source == "machines"
                else ""
            )
            raise LimitReachedError(
                f"your containers would have {_plain(kind, asked)} {_UNITS.get(kind, kind)} in all, and you "
                f"may have {_plain(kind, limit.most)}{share}; make others smaller (rce resize) or destroy "
                f"them, or {_advice(user, kind)}"
            )


def check_packages(tables: Tables, settings: StateSettings, user: str, size: int) -> None:
    """Check that a user may keep one more version of a package.

    Args:
        tables: What there is.
        settings: The limits.
        user: Whose it is.
        size: Bytes of its files, as far as they are known.

    Raises:
        LimitReachedError: There are too many, or they are too large.
    """
    used = used_of(tables, user)
    limit = limit_of(tables, settings, user, "packages")
    if limit.most and used["packages"] >= limit.most:
        raise LimitReachedError(
            f"you have {used['packages']:g} versions of packages already; remove one first, "
            f"or {_advice(user, 'packages')}"
        )
    limit = limit_of(tables, settings, user, "disk")
    if limit.most and used["disk"] + size > limit.most:
        raise LimitReachedError(
            f"your packages and volumes would have {used['disk'] + size:.0f} bytes, {limit.most:.0f} are "
            f"allowed; remove a version or a volume first, or {_advice(user, 'disk')}"
        )


_SETTINGS = {
    "containers": "max_containers",
    "slots": "max_slots",
    "cpu": "max_cpu",
    "memory": "max_memory",
    "packages": "max_packages",
    "disk": "max_package_size",
}


def _offered(tables: Tables, kind: str) -> float:
    """Sum up the resources of all known machines, including those that are away."""
    offered = tables.rooms.offered
    return {"slots": offered.slots, "cpu": offered.cores, "memory": offered.memory}[kind]


def _asked(total: Promise, kind: str) -> float:
    return {"slots": total.slots, "cpu": total.cpu, "memory": total.memory}[kind]


def _plain(kind: str, amount: float) -> str:
    return write_cores(amount / MEGABYTE if kind == "memory" else amount)


def _advice(user: str, kind: str) -> str:
    return f"have an administrator allow more: rce user limit {user} --{kind}"
