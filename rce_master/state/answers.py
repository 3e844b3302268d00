"""Answers that are kept, so that a request that is repeated is not done twice.

An answer is written in the transaction of what its request did. It is kept for :data:`KEPT_S`, and of one
user the newest :data:`MAX_ANSWERS`.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

from rce_master.exceptions import ConflictError

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import ForgetAnswers
    from rce_master.state.user_records import KeptAnswer

KEPT_S = 3600.0
MAX_ANSWERS = 1000
"""Of one user."""
_MAX_FORGOTTEN = 256
"""By one command."""


def keep(tx: Transaction, answer: KeptAnswer) -> None:
    """Keep an answer, in place of those of its user that are too old or too many.

    Raises:
        ConflictError: There is one for the same key.
    """
    kept = tx.tables.answers
    if answer.id in kept:
        raise ConflictError(
            "a request with this Idempotency-Key was done meanwhile; repeat it for its answer"
        )
    if answer.user not in tx.tables.users:
        return
    while kept.count("user", answer.user):
        oldest = kept[next(iter(kept.keys("user", answer.user)))]
        if not is_over(oldest, answer.created) and kept.count("user", answer.user) < MAX_ANSWERS:
            break
        tx.delete(kept, oldest.id)
    tx.put(answer)


def forget_old(tx: Transaction, command: ForgetAnswers) -> None:
    """Forget answers that are too old, a part of them if there are many."""
    for answer in list(islice(tx.tables.answers, _MAX_FORGOTTEN)):
        if not is_over(answer, command.now):
            break
        tx.delete(tx.tables.answers, answer.id)


def forget_user(tx: Transaction, user: str) -> None:
    """Forget all answers to a user."""
    for answer in tx.tables.answers.by("user", user):
        tx.delete(tx.tables.answers, answer.id)


def is_over(answer: KeptAnswer, now: float) -> bool:
    """Return whether an answer is too old to be given.

    Args:
        answer: The answer.
        now: Seconds since 1970.
    """
    return answer.created + KEPT_S <= now
