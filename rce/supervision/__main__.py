"""``python -m rce.supervision FD ...``: the process of ``rce up``, once its settings are read."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from typing import TYPE_CHECKING

import uvloop

from rce.aio.tasks import errors_in
from rce.own_process import EndSignals, end_signals
from rce.supervision.plan import Plan
from rce.supervision.prefork import Prepared, prepare
from rce.supervision.supervisor import StartError, Supervisor
from rce.tls import CertificateError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AbstractAsyncContextManager


async def run(plan: Plan, prepared: Mapping[str, Prepared]) -> int:
    """Run an engine until SIGINT, SIGTERM or SIGHUP; returns the exit code.

    A second signal ends containers without waiting for their nodes. No process is left, however this ends.
    """
    task = asyncio.current_task()
    assert task is not None
    supervisor = Supervisor(plan.programs, _say, prepared)
    EndSignals(task, again=supervisor.hurry).handle()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, end_signals())
    for line in plan.warnings:
        _complain(line)
    faults: tuple[BaseException, ...] = ()
    with contextlib.suppress(asyncio.CancelledError):
        try:
            async with _certificates(plan):
                await supervisor.run(lambda: _say("\n".join(plan.ready)))
        except* (StartError, OSError, CertificateError) as group:
            faults = tuple(errors_in(group))
        finally:
            supervisor.drop_unused()
    for fault in faults:
        _complain(f"rce up: {fault}")
    return 1 if faults else 0


def _certificates(plan: Plan) -> AbstractAsyncContextManager[None]:
    if not plan.certified:
        return contextlib.nullcontext()
    # Takes 10 MB, which only engines with TLS spend.
    from rce.config import load_settings, read_document
    from rce.tls.keeping import keep_certificates

    settings = load_settings(None, read_document(plan.certified, "the plan"))
    return keep_certificates(settings, lambda text: _say(f"[up] {text}"))


def _say(line: str) -> None:
    with contextlib.suppress(OSError):  # a full disk or a closed pipe must not end the programs
        print(line, flush=True)  # noqa: T201 - the programs' output


def _complain(line: str) -> None:
    with contextlib.suppress(OSError):  # as above
        print(line, file=sys.stderr, flush=True)  # noqa: T201 - for the caller


def main() -> int:
    """Run the plan whose file is the first argument; returns the exit code."""
    try:
        # Until the loop handles them: a signal would leave forks that end a moment after this process.
        signal.pthread_sigmask(signal.SIG_BLOCK, end_signals())
        plan = Plan.take_over(int(sys.argv[1]))
        return uvloop.run(run(plan, prepare(plan.programs, plan.shared)))
    except KeyboardInterrupt:  # before signals are handled: nothing runs yet
        return 128 + signal.SIGINT


if __name__ == "__main__":
    sys.exit(main())
