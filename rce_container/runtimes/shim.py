"""The shim: a shell in its own session that outlives the manager and waits for a container's end.

It enters the container's cgroups, runs the container's main command, waits for it, and removes the
container's folders and cgroups. If the command did not end properly, the shim waits longer, so that a manager
can inspect the remains.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rce_container.environment import proc
from rce_container.environment.logs.files import ENVIRONMENT_LOG, segment_path
from rce_container.exceptions import StartError

if TYPE_CHECKING:
    from rce_container.runtimes.base import Order

SHELL = "/bin/sh"

# When all has ended, the shim leaves the container's cgroups BASE/TASK_SET/MARK, each for the one in which
# the engine is (see rce_container.limits.cgroup2), and removes them: the manager may have ended.
_SHIM = """
trap : HUP INT TERM
folder=$1 run=$2 linger=$3 python=$4 sweeper=$5 mark=$6 switch=$7 joined=1 cells=
shift 7
[ -z "$switch" ] || exec 9<"$switch"
while [ "$1" != -- ]; do
    echo $$ >"$1" || joined=
    cells="$cells${1%/*}
"
    shift
done
shift
[ "$joined" ] && "$@" 9<&- && linger=0
exec 0</dev/null 1>&2
[ "$linger" = 0 ] || sleep "$linger"
[ -z "$sweeper" ] || "$python" -SE "$sweeper" "$mark"
rm -rf -- "$run" "$folder" 2>/dev/null || { chmod -R u+rwx -- "$folder"; rm -rf -- "$folder"; }
set -f
IFS='
'
for cell in $cells; do
    base=${cell%/*/*}
    echo $$ >"$base/rce-engine/cgroup.procs" || echo $$ >"$base/cgroup.procs"
    rmdir "$cell" "${cell%/*}"
done 2>/dev/null
"""


def spawn_shim(
    order: Order,
    argv: Sequence[str],
    env: Mapping[str, str],
    streams: tuple[int, int],
    *,
    sweep: bool = False,
    keep: Sequence[int] = (),
) -> tuple[subprocess.Popen[bytes], proc.Process]:
    """Start a shim: a command is run in the container's cgroups and waited for, and its folders are removed.

    Args:
        order: The container.
        argv: The command. If it ends with another code than 0, the folders stay for the grace time.
        env: Its environment variables.
        streams: Its standard input and output; standard error is the environment's log.
        sweep: Kill remaining processes that carry the container's mark.
        keep: Descriptors that it inherits.

    Raises:
        StartError: It cannot be started.
    """
    folder = order.folder
    shim = [SHELL, "-c", _SHIM, "rce-container-shim", str(folder.path), str(folder.run)]
    shim += [
        f"{order.boot.grace:g}",
        sys.executable,
        proc.__file__ if sweep else "",
        folder.incarnation_id,
        order.switch,
    ]
    shim += [*order.join, "--", *argv]
    stdin, stdout = streams
    try:
        with segment_path(folder.logs, ENVIRONMENT_LOG, 0).open("ab") as log:
            popen = subprocess.Popen(  # noqa: S603
                shim,
                stdin=stdin,
                stdout=stdout,
                stderr=log,
                env=env,
                pass_fds=keep,
                start_new_session=True,
            )
    except OSError as error:
        raise StartError(f"cannot start {SHELL}: {error}") from error
    process = proc.read(
        popen.pid, zombies=True
    )  # one that ended at once is reported like one that ends later
    if process is None:
        raise StartError(f"{SHELL} ended at once with code {popen.wait()}")
    return popen, process
