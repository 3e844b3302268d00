"""The signals that end a program."""

from __future__ import annotations

import signal


def end_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that tell this program to end: Ctrl-C, SIGTERM, and a terminal that is closed.

    SIGHUP counts only if it is not ignored, as it is for programs that ``nohup`` starts.
    """
    ends = (signal.SIGINT, signal.SIGTERM)
    return ends if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (*ends, signal.SIGHUP)
