"""Programs that are started without standard streams."""

from __future__ import annotations

import subprocess
import sys

import pytest

_SHOW = (
    "from rce.own_process import open_missing_streams; import os; open_missing_streams();"
    " os.write(int(os.environ['OUT']), ' '.join(sorted(os.listdir('/proc/self/fd'))).encode())"
)


@pytest.mark.parametrize("closed", ["", "<&-", ">&-", "<&- >&- 2>&-"])
def test_closed_streams_are_opened_and_nothing_else_is(closed: str) -> None:
    script = f'exec 9>&1; OUT=9 exec "$0" -c "$1" {closed}'
    done = subprocess.run(
        ["sh", "-c", script, sys.executable, _SHOW], capture_output=True, text=True, check=True
    )
    *streams, listing, out = done.stdout.split()
    assert streams == ["0", "1", "2"]
    assert (listing, out) == ("3", "9")
