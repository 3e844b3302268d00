"""A user of an engine, at a terminal."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from support.engine import Engine
from support.forked_commands import run_command


class Owner:
    """Somebody with a folder of their own, at a terminal."""

    def __init__(self, engine: Engine, name: str) -> None:
        self.engine = engine
        self.folder = engine.folder / f"home-{name}"
        self.folder.mkdir()
        self.name = name
        self.env = {**engine.env, "RCE_LOGIN_FILE": str(self.folder / "login.json")}

    async def start(self, *words: str, **streams: int) -> asyncio.subprocess.Process:
        """Start ``rce`` with pipes, but for the streams that are given."""
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), asyncio.subprocess.PIPE)
        return await asyncio.create_subprocess_exec(
            str(Path(sys.executable).parent / "rce"),
            *words,
            cwd=self.folder,
            env={**self.env, "COLUMNS": "200"},
            **{**pipes, **streams},  # type: ignore[arg-type]  # the streams are keywords of it
        )

    async def run(self, *words: str, typed: str = "") -> tuple[int, str]:
        """Run ``rce WORDS``; return its exit code and what it printed, on both streams."""
        return await run_command(words, env={**self.env, "COLUMNS": "200"}, folder=self.folder, typed=typed)

    async def rce(self, *words: str, typed: str = "", fails: bool = False) -> str:
        code, text = await self.run(*words, typed=typed)
        assert (code != 0) == fails, text
        return text

    async def login(self) -> None:
        await self.rce("login", self.engine.url, "--user", self.name, "--password-stdin", typed=self.name)
