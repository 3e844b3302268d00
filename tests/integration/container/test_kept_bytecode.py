"""A container task set compiles its modules once; where it cannot keep the result, it does not try."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

OTHER_USER = 65534
SCRIPT = """
import json, os, sys
from pathlib import Path
from rce_container.runtimes import namespace
folder, user = Path(sys.argv[1]), int(sys.argv[2])
namespace._python_packages = lambda: [folder]
if user:
    os.setresuid(user, user, user)
compiled = []
sys.addaudithook(lambda event, args: compiled.append(str(args[1])) if event == "compile" else None)
namespace._compile()
print(json.dumps([name for name in compiled if name.startswith(str(folder))]))
"""


def compiled(folder: Path, user: int = 0) -> list[str]:
    """Return what a program compiles that makes containers, as this user or as another one."""
    argv = [sys.executable, "-c", SCRIPT, str(folder), str(user)]
    done = subprocess.run(argv, check=True, capture_output=True, text=True)
    return list(json.loads(done.stdout))


@pytest.mark.needs("root")
def test_modules_of_another_user_are_not_compiled(folder: Path) -> None:
    folder.chmod(0o755)
    module = folder / "module.py"
    module.write_text("answer = 42\n")
    assert compiled(folder, OTHER_USER) == []
    assert compiled(folder) == [str(module)]
    assert compiled(folder) == [], "what was compiled is kept"
