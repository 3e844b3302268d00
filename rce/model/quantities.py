"""Amounts of processor time, memory and bandwidth, as users write them.

==========  ==============================  ==================================================
amount      a plain number means            as text
==========  ==============================  ==================================================
processor   cores: ``0.5``                  ``"50%"`` of one core, ``"0.5"``
memory      MB of 2^20 bytes: ``256``       ``"256M"``, ``"1G"``, ``"512MiB"``, ``"200000B"``
bandwidth   bytes per second: ``5000000``   ``"5M"``, ``"2.5MB/s"``, ``"10Mbit"``, ``"1Gbit/s"``
==========  ==============================  ==================================================

The prefixes of memory are powers of 1024, with and without the ``i``; those of bandwidth are powers of 1000,
and of 1024 with the ``i``. Zero: not requested.
"""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation

MEGABYTE = 1 << 20
"""Bytes of 1 MB, wherever memory is given in MB."""
MIN_MEMORY = 32 * MEGABYTE
"""Least memory of a container (bytes): its environment alone needs most of this."""
MEMORY_PER_SLOT = 64 * MEGABYTE
"""A machine offers one slot for so many bytes of its memory, unless its operator says otherwise."""
MAX_CORES = 2**16
MAX_MEMORY = 2**44
"""Bytes."""
MAX_BANDWIDTH = 2**50
"""Bytes per second."""

_NUMBER = r"(?P<number>[0-9]{1,20}(?:\.[0-9]{1,20})?)"
_CORES = re.compile(rf"{_NUMBER}\s*(?P<percent>%)?")
_MEMORY = re.compile(rf"{_NUMBER}\s*(?:(?P<prefix>[KMGT])(?:i?B)?|(?P<byte>B))?", re.IGNORECASE)
# The case of b counts here: for networks, it distinguishes bits from bytes.
_BANDWIDTH = re.compile(rf"{_NUMBER}\s*(?P<prefix>[kKMGT]i?)?(?P<unit>B|bit)?(?:/s|ps)?")

_POWERS = {"": 0, "k": 1, "m": 2, "g": 3, "t": 4}
_MEBI = 2**20

_CORES_HELP = 'a number of cores such as 0.5, or a text such as "50%"'
_MEMORY_HELP = 'a number of MB such as 256, or a text such as "256M" or "1G"'
_BANDWIDTH_HELP = 'a number of bytes per second, or a text such as "5M" (bytes) or "10Mbit"'


def read_cores(value: object) -> float:
    """Read a share of the processors.

    Args:
        value: A number of cores, or a text such as ``"50%"``.

    Returns:
        Cores.

    Raises:
        ValueError: The value is not valid; the text says what is.
    """
    if not isinstance(value, str):
        cores = _plain(value, _CORES_HELP)
    else:
        found = _match(_CORES, value, _CORES_HELP)
        cores = Decimal(found["number"]) / (100 if found["percent"] else 1)
    if cores > MAX_CORES:
        raise ValueError(f"must be at most {MAX_CORES} cores, not {value!r:.40}")
    return float(cores)


def read_memory(value: object) -> int:
    """Read an amount of memory.

    Args:
        value: A number of MB, or a text such as ``"256M"``.

    Returns:
        Bytes.

    Raises:
        ValueError: The value is not valid; the text says what is.
    """
    if not isinstance(value, str):
        amount = _plain(value, _MEMORY_HELP) * _MEBI
        if amount > MAX_MEMORY:
            raise ValueError(
                f"must be at most {MAX_MEMORY // _MEBI} MB, not {value!r:.40}; "
                f'a plain number is MB, bytes are written "{value!r:.40}B"'
            )
    else:
        found = _match(_MEMORY, value, _MEMORY_HELP)
        unit = 1 if found["byte"] else 1024 ** _POWERS[(found["prefix"] or "M").lower()]
        amount = Decimal(found["number"]) * unit
        if amount > MAX_MEMORY:
            raise ValueError(f"must be at most {write_memory(MAX_MEMORY)}, not {value!r:.40}")
    return round(amount)


def read_bandwidth(value: object) -> int:
    """Read a bandwidth.

    Args:
        value: A number of bytes per second, or a text such as ``"10Mbit"``.

    Returns:
        Bytes per second.

    Raises:
        ValueError: The value is not valid; the text says what is.
    """
    if not isinstance(value, str):
        rate = _plain(value, _BANDWIDTH_HELP)
    else:
        found = _match(_BANDWIDTH, value, _BANDWIDTH_HELP)
        prefix = (found["prefix"] or "").lower()
        base = 1024 if prefix.endswith("i") else 1000
        rate = Decimal(found["number"]) * base ** _POWERS[prefix.rstrip("i")]
        if found["unit"] == "bit":
            rate /= 8
    if rate > MAX_BANDWIDTH:
        raise ValueError(f"must be at most {write_bandwidth(MAX_BANDWIDTH)} per second, not {value!r:.40}")
    return round(rate)


def write_cores(cores: float) -> str:
    """Write cores so that :func:`read_cores` reads the same, to a ten thousandth."""
    return f"{cores:.4f}".rstrip("0").rstrip(".")


def write_memory(count: int) -> str:
    """Write bytes with the largest prefix that loses nothing; :func:`read_memory` reads the same."""
    return _exact(count, 1024, ("T", "G", "M", "K"), "B")


def write_plain_memory(count: int) -> int | str:
    """Write bytes as a number of MB, or as a text if that is not whole; :func:`read_memory` reads it."""
    megabytes, rest = divmod(count, _MEBI)
    return f"{count}B" if rest else megabytes


def write_bandwidth(rate: int) -> str:
    """Write bytes per second with the largest prefix that loses nothing; :func:`read_bandwidth` reads it."""
    return _exact(rate, 1000, ("T", "G", "M", "k"), "B")


def about(count: float, unit: str = "B") -> str:
    """Write an amount for people: three digits and a prefix of 1024, such as ``1.21 GiB``."""
    if count < 999.5:  # noqa: PLR2004 - larger amounts need more than three digits
        return f"{count:.0f} {unit}"
    for prefix in ("Ki", "Mi", "Gi"):
        count /= 1024
        if count < 999.5:  # noqa: PLR2004
            return f"{count:.3g} {prefix}{unit}"
    return f"{count / 1024:.4g} Ti{unit}"


def _exact(count: int, base: int, prefixes: tuple[str, ...], one: str) -> str:
    for power, prefix in zip(range(len(prefixes), 0, -1), prefixes, strict=True):
        if count and count % base**power == 0:
            return f"{count // base**power}{prefix}"
    return f"{count}{one}"


def _plain(value: object, wanted: str) -> Decimal:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"must be {wanted}, not {value!r:.60}")  # noqa: TRY004 - one kind of error for all
    try:
        number = Decimal(repr(value))
        if number.is_finite() and number >= 0:
            return number
    except (InvalidOperation, ValueError):
        pass  # Python does not convert integers of thousands of digits to text; none is a valid amount
    raise ValueError(f"must be {wanted}, and not below zero or endless")


def _match(pattern: re.Pattern[str], text: str, wanted: str) -> re.Match[str]:
    found = pattern.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"must be {wanted}, not {text!r:.60}")
    return found
