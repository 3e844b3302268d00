"""Whether this master leads: a table of roles, and the deadline until which it may act. Pure.

Times are seconds of a clock that also runs while the machine is suspended (``CLOCK_BOOTTIME``): a master that
wakes up must not act on a lease that ended meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from rce.lifecycle import LifeCycle
from rce_master.exceptions import FencedError, TransitionError

if TYPE_CHECKING:
    from collections.abc import Callable


class Role(Enum):
    """The roles of a master among others."""

    STANDBY = "stand-by"
    """Another master leads, or none does yet; this one waits."""
    CANDIDATE = "candidate"
    """No master leads; this one has a lease and tries to take the lead with it."""
    LEADING = "leading"
    """It holds the leader key, and renews its lease."""
    STEPPING_DOWN = "stepping down"
    """Its lease has ended or is being given back; it answers nothing any more, and lets go of everything."""


class LeadershipEvent(Enum):
    """What happens to a master's role."""

    GRANTED = "granted"
    """etcd gave it a lease."""
    ELECTED = "elected"
    """It wrote the leader key, and a new term with it."""
    REFUSED = "refused"
    """Another master was faster, or etcd did not answer in time."""
    LOST = "lost"
    """Its deadline passed, its lease ended, or a newer term began."""
    RESIGNED = "resigned"
    """It was told to end, and hands over."""
    RELEASED = "released"
    """It has let go of everything of its term."""


_R, _E = Role, LeadershipEvent
LEADERSHIP_LIFE = LifeCycle(
    "leadership",
    {
        _R.STANDBY: {_E.GRANTED: _R.CANDIDATE},
        _R.CANDIDATE: {_E.ELECTED: _R.LEADING, _E.REFUSED: _R.STANDBY},
        _R.LEADING: {_E.LOST: _R.STEPPING_DOWN, _E.RESIGNED: _R.STEPPING_DOWN},
        _R.STEPPING_DOWN: {_E.RELEASED: _R.STANDBY},
    },
    error=TransitionError,
)

STANDBY_HEADER = "RCE-Standby"
"""In answers of a master that does not lead: the request was not done, and another master may do it."""
LEADER_HEADER = "RCE-Leader"
"""In the same answers: the URL of the leading master, where a WebSocket can be opened."""
RENEWALS = 6
"""Renewals of a lease in the time that it lasts."""
POLL_S = 0.25
"""Longest time from one look of a stand-by at the leader key to the next, while it does not watch the key."""
WATCHED_POLL_S = 2.0
"""The same while it does. A watch tells of a change at once, but one that is silent proves nothing: its
connection may be dead, its member of etcd cut off from the others, and releases of etcd have lost events.
Only a read that a majority agrees on proves that a master leads."""


@dataclass(frozen=True, slots=True)
class LeaseSettings:
    """Times of leadership, in seconds."""

    ttl: float = 3.0
    """How long a lease lasts without a renewal."""
    margin: float = 0.1
    """Part of a lease's time that its holder does not use, so that clocks may differ in speed."""
    drained_wait: float = 10.0
    """How long no master leads until one that is drained takes the lead."""

    @property
    def renewal(self) -> float:
        """Time from one renewal to the next."""
        return self.ttl / RENEWALS

    @property
    def revocation(self) -> float:
        """Time that one member of etcd has to end a lease before the next one is asked."""
        return self.ttl / (2 * RENEWALS)

    @property
    def poll(self) -> float:
        """Time from one look of a stand-by at the leader key to the next, without a watch of the key."""
        return min(POLL_S, self.ttl / (2 * RENEWALS))

    @property
    def watched_poll(self) -> float:
        """The same while a watch tells of changes."""
        return max(self.poll, min(WATCHED_POLL_S, self.ttl - self.renewal))


class LeadershipCore:
    """The role of one master. Every method takes the time or needs none.

    Args:
        settings: Times.

    Attributes:
        role: The present role.
        term: The term in which it leads, or led last; 0: none.
        deadline: Time until which it may act as the leader; of use while it leads only.
        heard: The newest term that a task set has seen; the next term must be greater.
    """

    def __init__(self, settings: LeaseSettings) -> None:
        self.settings = settings
        self._machine = LEADERSHIP_LIFE.start(Role.STANDBY)
        self.term = 0
        self.deadline = 0.0
        self.heard = 0
        self._renew_at = 0.0
        self._free_since: float | None = None
        """When this stand-by first saw that no master leads; None: one leads, or it does not know."""

    @property
    def role(self) -> Role:
        """The present role."""
        return self._machine.state

    def looked(self, *, is_led: bool | None, is_drained: bool, now: float) -> bool:
        """Take what a stand-by saw at etcd; return whether it is to try to take the lead.

        Args:
            is_led: Whether a master leads; None: etcd cannot be asked.
            is_drained: Whether this master is not to lead, unless no other one does.
            now: The time.
        """
        if is_led is not False:
            self._free_since = None
            return False
        if self._free_since is None:
            self._free_since = now
        return not is_drained or now - self._free_since >= self.settings.drained_wait

    def granted(self, sent: float, ttl: float) -> None:
        """Take a lease that etcd gave.

        Args:
            sent: Time before it was asked for.
            ttl: The seconds that etcd gave.
        """
        self._machine.advance(LeadershipEvent.GRANTED)
        self._extend(sent, ttl)

    def elected(self, term: int, now: float) -> None:
        """Take the lead, unless the lease has ended while this master tried.

        Raises:
            FencedError: It has; the role is stand-by.
        """
        if now >= self.deadline:
            self.refused()
            raise FencedError("the lease ended while this master took the lead")
        self._machine.advance(LeadershipEvent.ELECTED)
        self.term = term

    def refused(self) -> None:
        """Become a stand-by again: the lead could not be taken."""
        self._machine.advance(LeadershipEvent.REFUSED)

    def renewed(self, sent: float, ttl: float) -> None:
        """Take the answer to a renewal.

        Args:
            sent: Time before it was sent.
            ttl: The seconds that etcd gave; 0: the lease has ended.
        """
        if self.role is not Role.LEADING:
            return
        if ttl <= 0 or sent >= self.deadline:
            self._machine.advance(LeadershipEvent.LOST)
        else:
            self._extend(sent, ttl)

    def lost(self) -> None:
        """Lead no more, for a reason other than the deadline: a newer term, a key that was removed."""
        if self.role is Role.LEADING:
            self._machine.advance(LeadershipEvent.LOST)

    def overtaken(self, term: int) -> None:
        """Hear of a newer term: another master leads, or etcd was restored from an older copy."""
        self.heard = max(self.heard, term)
        self.lost()

    def resigned(self) -> None:
        """Begin to hand over, unless the lead was lost already."""
        if self.role is Role.LEADING:
            self._machine.advance(LeadershipEvent.RESIGNED)

    def released(self) -> None:
        """Become a stand-by: nothing of the term is left."""
        self._free_since = None
        self._machine.advance(LeadershipEvent.RELEASED)

    def remaining(self, now: float) -> float:
        """Tell how many seconds this master may still act as the leader; 0 or less if it may not."""
        return self.deadline - now if self.role in (Role.LEADING, Role.CANDIDATE) else 0.0

    def look(self, now: float) -> bool:
        """Look at the time; return whether this master leads."""
        if self.role is Role.LEADING and now >= self.deadline:
            self._machine.advance(LeadershipEvent.LOST)
        return self.role is Role.LEADING

    def until_renewal(self, now: float) -> float:
        """Tell how many seconds are left until the next renewal, or until the deadline if it comes first."""
        return max(0.0, min(self._renew_at, self.deadline) - now)

    def _extend(self, sent: float, ttl: float) -> None:
        usable = min(ttl, self.settings.ttl) * (1 - self.settings.margin)
        # Answers may come in another order than their requests were sent in.
        self.deadline = max(self.deadline, sent + usable) if self.role is Role.LEADING else sent + usable
        self._renew_at = sent + self.settings.renewal


class Fence:
    """Tells the parts of a leading master whether they may still act.

    Args:
        core: The leadership.
        clock: Its clock.

    Attributes:
        term: The term of the leadership that this fence belongs to.
        name: The name by which this master leads.
    """

    def __init__(self, core: LeadershipCore, clock: Callable[[], float], name: str) -> None:
        self.term = core.term
        self.name = name
        self._core = core
        self._clock = clock

    @property
    def is_closed(self) -> bool:
        """Whether this master may not act as the leader of this term any more."""
        return not self._core.look(self._clock()) or self._core.term != self.term

    def check(self) -> None:
        """Check that this master may still act.

        Raises:
            FencedError: It may not.
        """
        if self.is_closed:
            raise FencedError("this master leads no more; ask the one that leads now")

    def heed(self, term: int) -> None:
        """Step down if a task set has seen a newer term.

        Raises:
            FencedError: It has.
        """
        if term > self.term:
            self._core.overtaken(term)
            raise FencedError(f"this master leads in term {self.term}, and term {term} has begun")
