"""Packages that users push, through the commands and the API of a real master."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import stat
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.ports import free_port

from rce.config.secret import Secret
from rce.control.exceptions import ContentError
from rce.control.messages import Put
from rce.control.model import EndpointSpec
from rce.control_channel.contents import ContentClient
from rce.masters import Masters
from rce.packages.folder import look_into
from rce.packages.signing import SigningKey, key_id, statement
from rce_master.cli import packages, signing_key
from rce_master.cli.client import ApiClient
from rce_master.cli.credentials import FILE_VARIABLE, Credentials, save
from rce_master.cli.exceptions import ApiError, CliError
from rce_master.state.settings import StateSettings
from rce_master.store import MemoryStore

if TYPE_CHECKING:
    from integration.master.conftest import RunSite, Site, TaskSet


@pytest.fixture
async def shop(run_site: RunSite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Site]:
    """A master with a folder of its own, where testUser is logged in."""
    async with run_site(state_dir=tmp_path / "master") as site:
        log_in(site, tmp_path, monkeypatch)
        yield site


def log_in(site: Site, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FILE_VARIABLE, str(folder / "cli" / "login.json"))
    save(Credentials(url=site.url, user="testUser", token=site.token, expires=1e12))


def make_package(folder: Path, name: str = "nav", text: str = "print('hi')\n", **more: str) -> Path:
    package = folder / name
    (package / "nodes").mkdir(parents=True, exist_ok=True)
    (package / "package.yaml").write_text(f"name: {name}\nversion: '1.0'\n")
    (package / "nodes" / "run.py").write_text(text)
    for path, contents in more.items():
        (package / path.replace("_txt", ".txt")).write_text(contents)
    return package


async def push(folder: Path, version: str = "") -> None:
    await packages._push(folder, version, every=False, dry_run=False)


def stored(folder: Path) -> set[str]:
    kept = folder / "master" / "bundles"
    return {path.name for path in kept.iterdir() if path.is_file()} if kept.exists() else set()


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.01)


async def test_a_package_comes_in_is_listed_and_goes(
    shop: Site, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    await push(make_package(tmp_path))
    told = capsys.readouterr().out
    assert "nodes/run.py" in told
    assert "registered the key" in told
    assert '"pkg": "nav@1.0" or "pkg": "nav"' in told
    assert stat.S_IMODE(signing_key.key_file().stat().st_mode) == 0o600
    await packages._list("")
    await packages._show("nav", "", "")
    await packages._show_keys()
    told = capsys.readouterr().out
    assert "1.0 (newest)" in told
    assert "run.py" in told
    assert "this machine's" in told
    assert len(stored(tmp_path)) == 1
    await packages._remove("nav", "1.0", "")
    with pytest.raises(CliError, match="there is no package 'nav'"):
        await packages._show("nav", "", "")
    await until(lambda: not stored(tmp_path))


async def test_a_version_never_changes(shop: Site, tmp_path: Path) -> None:
    package = make_package(tmp_path)
    await push(package)
    await push(package)  # the same again is well
    make_package(tmp_path, text="print('other')\n")
    with pytest.raises(ApiError, match="a version never changes"):
        await push(package)
    await push(package, version="1.1")
    listed = (await shop.api("GET", "/packages"))["packages"]
    assert [(one["version"], one["newest"]) for one in listed] == [("1.0", False), ("1.1", True)]
    first = await shop.api("GET", "/packages", limit=1)
    second = await shop.api("GET", "/packages", limit=1, cursor=first["next"])
    assert [*first["packages"], *second["packages"]] == listed
    assert second["next"] is None
    assert len(stored(tmp_path)) == 2


async def test_nodes_get_what_they_name(shop: Site, tmp_path: Path) -> None:
    package = make_package(tmp_path)
    await push(package)
    async with shop.containers() as containers:
        await shop.api("POST", "/containers", {"tag": "c"}, status=204)
        node = {"exe": "run.py", "pkg": "nav"}
        await shop.api("POST", "/containers/c/nodes", {"tag": "any", **node}, status=204)
        spec = await newest_spec(containers, lambda spec: bool(spec.nodes))
        assert [(b.name, b.version) for b in spec.packages] == [("nav", "1.0")]
        node["pkg"] = "nav@3.0"
        reply = await shop.api("POST", "/containers/c/nodes", {"tag": "fixed", **node}, status=404)
        assert "no package 'nav' of version '3.0'" in reply["error"]
        node["pkg"] = "nav@1.0"
        await shop.api("POST", "/containers/c/nodes", {"tag": "fixed", **node}, status=204)
        make_package(tmp_path, text="print('newer')\n")
        await push(package, version="1.10")
        await push(package, version="2.0-rc1")
        spec = await newest_spec(containers, lambda spec: len(spec.packages) == 2)
        assert [b.version for b in spec.packages] == ["1.0", "1.10"]
        reply = await shop.api("DELETE", "/packages/nav/1.10", status=409)
        assert "used by c/any" in reply["error"]
        await shop.api("DELETE", "/containers/c/nodes/any", status=204)
        await shop.api("DELETE", "/packages/nav/1.10", status=204)


async def newest_spec(containers: TaskSet, wanted: Callable[[EndpointSpec], bool]) -> EndpointSpec:
    while True:
        put: Put = await containers.get(Put)
        if wanted(put.endpoint):
            return put.endpoint


async def test_another_user_neither_sees_nor_uses_it(shop: Site, tmp_path: Path) -> None:
    await push(make_package(tmp_path))
    await shop.api("POST", "/users", {"name": "eve", "password": "evil"}, status=201)
    eve = await shop.login("eve", "evil")
    assert (await shop.api("GET", "/packages", token=eve))["packages"] == []
    await shop.api("GET", "/packages/nav/1.0", token=eve, status=404)
    await shop.api("GET", "/packages", token=eve, user="testUser", status=403)
    await shop.api("DELETE", "/packages/nav/1.0", token=eve, user="testUser", status=403)
    async with shop.containers() as containers:
        await shop.api("POST", "/containers", {"tag": "c"}, token=eve, status=204)
        node = {"tag": "n", "exe": "run.py", "pkg": "nav"}
        await shop.api("POST", "/containers/c/nodes", node, token=eve, status=204)
        spec = await newest_spec(containers, lambda spec: bool(spec.nodes))
        assert spec.packages == ()
        node |= {"tag": "m", "pkg": "nav@1.0"}
        await shop.api("POST", "/containers/c/nodes", node, token=eve, status=404)


async def send(
    site: Site,
    folder: Path,
    key: SigningKey,
    *,
    user: str = "testUser",
    spoil: bool = False,
    signature: str | None = None,
) -> tuple[int, str]:
    """Push as a program of one's own would, with something else told than what is true."""
    source = look_into(folder)
    archive = io.BytesIO()
    source.pack(archive)
    body = archive.getvalue()
    if signature is None:
        signature = key.sign(statement(user, "nav", "1.0", hashlib.sha256(body).hexdigest()))
    query = {"key": key.public, "signature": signature}
    headers = {"Authorization": f"Bearer {site.token}"}
    body = body[:-9] + bytes([body[-9] ^ 1]) + body[-8:] if spoil else body
    async with site.session.put(
        f"{site.url}api/v1/packages/nav/1.0", data=body, params=query, headers=headers
    ) as reply:
        return reply.status, await reply.text()


async def test_what_was_not_signed_by_a_known_key_is_refused(shop: Site, tmp_path: Path) -> None:
    package, key = make_package(tmp_path), SigningKey.generate()
    status, text = await send(shop, package, key)
    assert status == 403
    assert "not registered" in text
    await shop.api("POST", "/package-keys", {"key": key.public, "label": "x"}, status=201)
    for wrong in ("00" * 64, "xyz"):
        status, text = await send(shop, package, key, signature=wrong)
        assert (status, "does not fit the key" in text) == (422, True), text
    status, _ = await send(shop, package, key, user="eve")
    assert status == 422
    status, _ = await send(shop, package, key, spoil=True)
    assert status == 422
    assert stored(tmp_path) == set()
    status, text = await send(shop, package, key)
    assert status == 200, text
    await shop.api("DELETE", f"/package-keys/{key_id(key.public)}", status=204)
    status, _ = await send(shop, package, key)
    assert status == 403
    assert not list((tmp_path / "master" / "bundles" / "incoming").iterdir())


async def test_a_users_packages_have_limits(
    run_site: RunSite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with run_site(state_dir=tmp_path / "master", state=StateSettings(max_packages=1)) as site:
        log_in(site, tmp_path, monkeypatch)
        package = make_package(tmp_path)
        await push(package)
        with pytest.raises(ApiError, match="you have 1 versions of packages already"):
            await push(package, version="2.0")
    settings = StateSettings(max_package_bytes=10)
    async with run_site(state_dir=tmp_path / "master", state=settings) as site:
        log_in(site, tmp_path, monkeypatch)
        with pytest.raises(ApiError, match=r"the archives of your packages .* 10 are allowed"):
            await push(package)
    settings = StateSettings(max_package_size=11)
    async with run_site(state_dir=tmp_path / "master", state=settings) as site:
        log_in(site, tmp_path, monkeypatch)
        with pytest.raises(ApiError, match=r"your packages and volumes would have .* 11 are allowed"):
            await push(package)
        await until(lambda: not stored(tmp_path))


async def test_restarted_master_keeps_state_clears_begun_work(
    run_site: RunSite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A restarted master has what it had and clears what it had begun."""
    store = MemoryStore()
    async with run_site(store, state_dir=tmp_path / "master") as site:
        log_in(site, tmp_path, monkeypatch)
        await push(make_package(tmp_path))
    kept = stored(tmp_path)
    folder = tmp_path / "master" / "bundles"
    (folder / "incoming").mkdir(exist_ok=True)
    (folder / "incoming" / "half").write_text("x")
    (folder / ("0" * 64)).write_text("nobody knows it")
    async with run_site(store, state_dir=tmp_path / "master") as site:
        await until(lambda: stored(tmp_path) == kept and not (folder / "incoming" / "half").exists())
        assert [one["version"] for one in (await site.api("GET", "/packages"))["packages"]] == ["1.0"]


async def test_task_sets_fetch_contents_by_their_secret(shop: Site, tmp_path: Path) -> None:
    await push(make_package(tmp_path, data_txt="x" * 10))
    (sha256,) = stored(tmp_path)
    port = shop.master.control_port
    secret = Secret("a secret for the tests")
    client = ContentClient(Masters(f"ws://127.0.0.1:{port}"), secret)
    piece = await client.piece(sha256, 0)
    assert piece.data == (tmp_path / "master" / "bundles" / sha256).read_bytes()
    assert piece.size == len(piece.data)
    assert (await client.piece(sha256, 5)).data == piece.data[5:]
    with pytest.raises(ContentError) as caught:
        await client.piece("0" * 64, 0)
    assert caught.value.missing
    with pytest.raises(ContentError, match="bytes only"):
        await client.piece(sha256, piece.size)
    with pytest.raises(ContentError, match="secret"):
        await ContentClient(Masters(f"ws://127.0.0.1:{port}"), Secret("not the secret")).piece(sha256, 0)
    with pytest.raises(ContentError, match="does not hand it out"):
        await ContentClient(Masters("ws://127.0.0.1:1"), secret).piece(sha256, 0)


async def test_an_account_with_keys_takes_no_other_one_by_itself(shop: Site, tmp_path: Path) -> None:
    package = make_package(tmp_path)
    await push(package)
    signing_key.key_file().unlink()
    with pytest.raises(CliError, match="rce package key register"):
        await push(package, version="2.0")
    await packages._register_key("second")
    await push(package, version="2.0")
    assert len((await shop.api("GET", "/package-keys"))["keys"]) == 2
    signing_key.key_file().chmod(0o644)
    with pytest.raises(CliError, match="can be read by others"):
        await push(package, version="3.0")


async def test_requirements_are_warned_of(
    shop: Site, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    await push(make_package(tmp_path, requirements_txt="six\n-e .\n"))
    told = capsys.readouterr().err
    assert "no machine of this engine installs" in told
    assert "line 2" in told


async def test_removing_a_user_removes_their_packages(shop: Site, tmp_path: Path) -> None:
    await shop.api("POST", "/users", {"name": "boss", "password": "b", "role": "admin"}, status=201)
    await push(make_package(tmp_path))
    assert len(stored(tmp_path)) == 1
    boss = await shop.login("boss", "b")
    await shop.api("DELETE", "/users/testUser", token=boss, status=204)
    await until(lambda: not stored(tmp_path))
    with contextlib.suppress(ApiError):
        await packages._list("")


async def test_upload_finds_the_master_that_answers(shop: Site) -> None:
    """A file is sent once, so the client looks first which of its masters answers."""
    async with ApiClient(f"http://127.0.0.1:{free_port()},{shop.url}", shop.token) as client:
        with pytest.raises(ApiError) as refused:
            await client.upload("/packages/p/1.0", io.BytesIO(b"no archive"), {"key": "k", "signature": "s"})
    assert refused.value.status == 403, "the key is not known: the file reached the master"
