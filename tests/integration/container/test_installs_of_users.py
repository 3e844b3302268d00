"""Requirements of several users: one that never ends does not keep others' from being installed."""

from __future__ import annotations

import asyncio
import io
import zipfile
from typing import TYPE_CHECKING

import pytest
from aiohttp import web

from rce.web.server import HttpServer
from rce_container.packages.requirements import Installer, InstallerSettings

if TYPE_CHECKING:
    from pathlib import Path


def wheel(name: str) -> bytes:
    info = f"{name}-1.0.dist-info"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(f"{name}.py", "ANSWER = 42\n")
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return file.getvalue()


class Index:
    """An index of packages that never answers for some of them."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.slow = asyncio.Event()

    def app(self) -> web.Application:
        app = web.Application()
        app.router.add_get("/simple/{name}/", self.list)
        app.router.add_get("/files/{file}", self.file)
        return app

    async def list(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        self.asked.append(name)
        if name.startswith("slow"):
            self.slow.set()
            await asyncio.Event().wait()
        file = f"{name}-1.0-py3-none-any.whl"
        return web.Response(text=f'<a href="/files/{file}">{file}</a>', content_type="text/html")

    async def file(self, request: web.Request) -> web.Response:
        return web.Response(body=wheel(request.match_info["file"].partition("-")[0]))


def package(folder: Path, name: str, requirements: str) -> Path:
    made = folder / name
    made.mkdir()
    (made / "requirements.txt").write_text(f"{requirements}\n")
    return made


@pytest.mark.needs("bwrap")
async def test_a_slow_install_of_one_user_holds_up_no_other(tmp_path: Path) -> None:
    index = Index()
    async with HttpServer(index.app(), "127.0.0.1", 0) as server:
        arguments = (f"--index-url={server.url}simple", "--timeout=600")
        installer = Installer(tmp_path / "requirements", InstallerSettings(pip_args=arguments), {})
        installer.open()
        packages = {
            name: package(tmp_path, name, name) for name in ("slow_one", "slow_two", "quick", "other")
        }
        slow = asyncio.create_task(installer.install("anna", packages["slow_one"]))
        await index.slow.wait()
        second = asyncio.create_task(installer.install("anna", packages["quick"]))
        site = await installer.install("bert", packages["other"])
        assert (site / "other.py").is_file()
        # The first user's others wait for the first of them.
        assert "quick" not in index.asked
        slow.cancel()
        assert (await second / "quick.py").is_file()
        # What is there needs no turn.
        slow = asyncio.create_task(installer.install("anna", packages["slow_two"]))
        while "slow-two" not in index.asked:
            await asyncio.sleep(0.05)
        assert await installer.install("anna", packages["other"]) == site
        slow.cancel()
        await asyncio.gather(slow, return_exceptions=True)
