"""Masters whose clients see a certificate of a public authority: stand-bys forward over it too."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

import aiohttp
import pytest
from support.engine import until
from support.masters import DEV_USER, MasterProcess

from rce.tls.folder import CertificateFolder

if TYPE_CHECKING:
    from support.etcd import Cluster

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

LEASE_S = 10.0
NAME = "localhost"
"""The only name in the certificate: an address of a machine is in none of a public authority."""


class PublicMaster(MasterProcess):
    """A master that clients reach by a name, with a certificate of an authority that is not the engine's."""

    def __init__(self, folder: Path, name: str, store: str, public: CertificateFolder) -> None:
        super().__init__(folder, name, store, LEASE_S)
        files = ("--tls-cert", str(public.certificate(NAME)), "--tls-key", str(public.key(NAME)))
        self.argv += [*files, "--advertise", NAME]
        self.env["SSL_CERT_FILE"] = str(public.authority)  # in place of the system's authorities
        self._trust = ssl.create_default_context(cafile=public.authority)

    @property
    def url(self) -> str:
        return f"https://{NAME}:{self.http_port}/"

    async def role(self) -> str:
        """Return what it is: ``leader`` or ``standby``; empty if it does not answer."""
        with contextlib.suppress(aiohttp.ClientError):
            async with self.session() as session, session.get(f"{self.url}healthz") as reply:
                return str((await reply.json())["role"])
        return ""

    async def leads(self) -> bool:
        return await self.role() == "leader"

    async def log_in(self) -> tuple[int, str]:
        """Log in at this master; return the answer's status and text."""
        user = {"userID": DEV_USER, "password": DEV_USER}
        async with self.session() as session, session.post(f"{self.url}api/v1/login", json=user) as reply:
            return reply.status, await reply.text()

    async def until_logged_in(self) -> None:
        """Log in at this master, which may not know at first who leads."""
        async with asyncio.timeout(60):
            while (answer := await self.log_in())[0] == 503:
                assert "certificate" not in answer[1], answer
                await asyncio.sleep(0.1)
        assert answer[0] == 200, answer

    def session(self) -> aiohttp.ClientSession:
        return aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=self._trust))


@contextlib.asynccontextmanager
async def running(*masters: PublicMaster) -> AsyncIterator[None]:
    """Run masters; the first one leads."""
    try:
        for master in masters:
            await master.start(ready=": ")
            await until(master.role, timeout=120, what=f"{master.name} answers")
            if master is masters[0]:
                await until(master.leads, timeout=120, what=f"{master.name} leads")
        yield
    finally:
        for master in masters:
            if master.running:
                await master.stop()


@pytest.fixture
def public(tmp_path: Path) -> CertificateFolder:
    made = CertificateFolder(tmp_path / "public")
    made.make_authority()
    made.issue(NAME, (NAME,))
    return made


async def test_stand_bys_forward_over_a_public_certificate(
    etcd: Cluster, public: CertificateFolder, tmp_path: Path
) -> None:
    """Also once another master leads; and they do not, where that authority is not trusted."""
    first, second, third = (PublicMaster(tmp_path, f"m{number}", etcd.store, public) for number in range(3))
    third.env["SSL_CERT_FILE"] = ""  # of the system
    async with running(first, second, third):
        assert (await second.log_in())[0] == 200
        status, text = await third.log_in()
        assert (status, "certificate is not trusted" in text) == (503, True), text
        await third.stop()
        await first.kill()
        await until(second.leads, timeout=120, what="the second one leads")
        await first.start(ready="rce-master stand-by: ")
        await first.until_logged_in()
