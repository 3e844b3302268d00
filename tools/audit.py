"""Audits the pinned dependencies against a public database of vulnerabilities, as part of ``make lint``.

``python -m tools.audit [OPTIONS OF PIP-AUDIT]``. It ends with 1 if a dependency has a known vulnerability.
If the database cannot be reached, it prints one line about it and ends with 0.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

LOCK = Path(__file__).resolve().parent.parent / "requirements.lock"
TIMEOUT_S = 300
_AWAY = (
    *("connectionerror", "connecttimeout", "readtimeout", "proxyerror", "serviceerror"),
    *("connection refused", "connection reset", "failed to resolve", "name resolution", "timed out"),
)
"""What errors of an unreachable database contain, in lower case."""


def main(arguments: list[str]) -> int:
    """Audit, and return the exit code."""
    fixed = ("--requirement", str(LOCK), "--require-hashes", "--disable-pip")
    shown = ("--progress-spinner", "off", "--format", "json")
    argv = [sys.executable, "-m", "pip_audit", *fixed, *shown, *arguments]
    try:
        done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)  # noqa: S603
    except subprocess.TimeoutExpired:
        return _tell("not audited: no answer of the database of vulnerabilities", 0)
    try:
        found = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        reason = (done.stderr.strip().splitlines() or ["no output"])[-1]
        if any(word in done.stderr.lower() for word in _AWAY):
            return _tell(f"not audited: the database of vulnerabilities cannot be reached ({reason:.200})", 0)
        return _tell(f"pip-audit failed: {reason}", 1)
    return _judge(found)


def _judge(dependencies: list[dict[str, Any]]) -> int:
    skipped = [each["name"] for each in dependencies if "skip_reason" in each]
    vulnerable = [each for each in dependencies if each.get("vulns")]
    for each in vulnerable:
        for flaw in each["vulns"]:
            fix = ", ".join(flaw["fix_versions"]) or "none yet"
            _tell(f"{each['name']} {each['version']} is vulnerable: {flaw['id']}, fixed in {fix}", 1)
    if vulnerable:
        return 1
    if dependencies and len(skipped) == len(dependencies):
        return _tell(
            "not audited: the database of vulnerabilities cannot be reached, or knows none of them", 0
        )
    unknown = f"; not audited: {', '.join(skipped)}" if skipped else ""
    return _tell(f"{len(dependencies) - len(skipped)} dependencies have no known vulnerability{unknown}", 0)


def _tell(text: str, code: int) -> int:
    print(f"audit: {text}", file=sys.stderr if code else sys.stdout)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
