"""``rce audit``: who came in, who was refused, and who changed what."""

from __future__ import annotations

import asyncio
import json
import time
from typing import Annotated, Any

import typer

from rce.printable import one_line
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient, run

POLL_S = 1.0


def audit(
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Follow the audit log.")] = False,
    user: Annotated[str, typer.Option("--user", help="Only what this user did.")] = "",
    lines: Annotated[
        int, typer.Option("--lines", "-n", help="Number of newest records.", min=1, max=1000)
    ] = 100,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON lines.")] = False,
) -> None:
    """Show logins, refusals and changes (administrators)."""
    run(_audit(user, lines, follow=follow, as_json=as_json))


async def _audit(user: str, lines: int, *, follow: bool, as_json: bool) -> None:
    last, told = -lines, list[str]()
    async with ApiClient.of(credentials.load()) as client:
        while True:
            query: dict[str, str | int] = {"since": last, **({"user": user} if user else {})}
            answer = await client.call("GET", "/audit", query=query)
            records, missing = answer["records"], answer.get("missing", [])
            if missing != told:
                typer.echo(
                    "".join(f"rce audit: records are missing: {why}\n" for why in missing), err=True, nl=False
                )
                told = missing
            for record in records:
                typer.echo(json.dumps(record) if as_json else _line(record))
            if not follow:
                return
            last = records[-1]["id"] if records else max(last, 0)
            await asyncio.sleep(POLL_S)


def _line(record: dict[str, Any]) -> str:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record["time"]))
    words = [when, record["user"] or "(unknown)", record["action"], record["subject"]]
    if record["outcome"] != "done":
        words.append(record["outcome"])
    if record["detail"]:
        words.append(f"({record['detail']})")
    if record["times"] > 1:
        words.append(f"{record['times']} times")
    words += [
        f"{name} {record[key]}"
        for name, key in (("from", "address"), ("by", "via"), ("for", "client"))
        if record.get(key)
    ]
    return one_line("  ".join(word for word in words if word))
