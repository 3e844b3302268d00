"""A script in a forked process does what it does under ``python SCRIPT``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

RUN = """
import os, sys
import json  # something that a script would import, and that is there already
child = os.fork()
if child:
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        import signal
        signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)
from rce_container.forkserver.script import open_streams, run_script
open_streams(unbuffered={unbuffered})
run_script(sys.argv[1], sys.argv[2:])
"""

SCRIPTS = {
    "ordinary": "import sys, os\nprint(sys.argv[1:], __name__, os.path.basename(__file__), sys.path[0])\n",
    "code": "import sys\nprint('out')\nsys.exit(3)\n",
    "text": "import sys\nsys.exit('it is broken')\n",
    "error": "def f():\n    raise ValueError('wrong')\nf()\n",
    "syntax": "print('never')\nthis is not Python\n",
    "interrupt": "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n",
    "atexit": "import atexit\natexit.register(print, 'late')\nprint('early')\n",
    "atexit_interrupt": "import atexit\natexit.register(print, 'late')\nraise KeyboardInterrupt\n",
    "thread": (
        "import threading\nt = threading.Timer(0.1, print, ['from a thread'])\nt.start()\nprint('main')\n"
    ),
    "main": "import sys\nclass A: pass\nassert sys.modules['__main__'].A is A\nprint(A, __spec__, __doc__)\n",
    "pickled": "import pickle\nclass A: pass\nprint(type(pickle.loads(pickle.dumps(A()))) is A)\n",
    "annotations": "x: int = 1\nprint(__annotations__)\n",
    "unicode": "# -*- coding: latin-1 -*-\nprint(ascii('\xe4'))\n",
    "stdin": "import sys\nprint(repr(sys.stdin.read()))\n",
    "streams": "import sys\nprint(sys.stdout.encoding, sys.stdout.write_through, sys.stderr.errors)\n",
    "unflushed": "import os, sys\nsys.stdout.write('lost?')\nos._exit(0)\n",
    "closed": "import sys\nsys.stdout.close()\n",
    "spawn": (
        "import multiprocessing as m\ndef f(x):\n    return x * 2\n"
        "if __name__ == '__main__':\n"
        "    with m.get_context('spawn').Pool(1) as pool:\n        print(pool.map(f, [1, 2]))\n"
    ),
}


def run(argv: list[str], *, unbuffered: bool) -> tuple[int, str, str]:
    env = {"PATH": "/usr/bin:/bin", "LANG": "C.UTF-8", "PYTHONPATH": str(Path(__file__).parents[3])}
    if unbuffered:
        env["PYTHONUNBUFFERED"] = "1"
    done = subprocess.run(
        [sys.executable, *argv],
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=30,
        check=False,
    )
    return done.returncode, done.stdout.decode(), done.stderr.decode()


@pytest.mark.parametrize("unbuffered", [True, False])
@pytest.mark.parametrize("name", SCRIPTS)
def test_it_ends_and_prints_alike(tmp_path: Path, name: str, unbuffered: bool) -> None:
    script = tmp_path / f"{name}.py"
    script.write_bytes(SCRIPTS[name].encode("latin-1" if name == "unicode" else "utf-8"))
    words = [str(script), "one", "two words"]
    expected = run(words, unbuffered=unbuffered)
    assert run(["-c", RUN.format(unbuffered=unbuffered), *words], unbuffered=unbuffered) == expected


def test_a_script_that_is_not_there(tmp_path: Path) -> None:
    words = [str(tmp_path / "none.py")]
    code, _, text = run(["-c", RUN.format(unbuffered=True), *words], unbuffered=True)
    expected = run(words, unbuffered=True)
    assert (code, text) == (expected[0], expected[2])
