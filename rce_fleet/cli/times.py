"""Times on the command line of ``rce fleet``: times of day, dates, seconds from now."""

from __future__ import annotations

from datetime import datetime, timedelta

import typer


def read_time(text: str, now: float, option: str = "--until") -> float:
    """Return a local time, or a time of day that comes next, in seconds since 1970.

    Raises:
        typer.BadParameter: The text is not a time, or it has passed.
    """
    for time in _times(text, now, option, "a time"):
        if time > now:
            return time
    raise typer.BadParameter(f"{text} has passed", param_hint=option)


def read_moment(text: str, now: float, option: str) -> float | None:
    """Return seconds from now, a local time or a time of day that comes next, in seconds since 1970.

    A date and time may have passed: a request that is sent again has the same one.

    Returns:
        None if the text is 0, or empty.

    Raises:
        typer.BadParameter: The text is neither seconds nor a time.
    """
    try:
        seconds = float(text or "0")
    except ValueError:
        times = _times(text, now, option, "seconds from now, or a time")
        return times[0] if "-" in text else next(time for time in times if time > now)
    return now + seconds if seconds else None


def _times(text: str, now: float, option: str, expected: str) -> list[float]:
    """Return when a local time is: twice in the hour that autumn repeats; a time of day also tomorrow."""
    try:
        if "-" in text:
            days = [datetime.fromisoformat(text)]
        else:
            hour, minute = map(int, text.split(":"))
            today = datetime.fromtimestamp(now).astimezone().replace(tzinfo=None)
            due = today.replace(hour=hour, minute=minute, second=0, microsecond=0)
            days = [due, due + timedelta(days=1)]
        return [day.replace(fold=fold).timestamp() for day in days for fold in (0, 1)]
    except (ValueError, OverflowError):
        raise typer.BadParameter(
            f"expected {expected} such as 18:30 or 2026-11-28T18:30, found {text!r}", param_hint=option
        ) from None
