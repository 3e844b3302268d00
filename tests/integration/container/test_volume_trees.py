"""Trees of files that are read, copied while programs write, and made again."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rce.control import SnapshotError
from rce.control.snapshots import HOLE, PIECE, FileEntry, LinkEntry, Manifest, digest
from rce.model import MEGABYTE
from rce_container.descent import MAX_DEPTH, stats_below
from rce_container.files import size_of
from rce_container.volumes import images, tree
from rce_container.volumes.freezing import frozen
from rce_container.volumes.measuring import measure
from rce_container.volumes.mounted import open_image, open_inside
from rce_container.volumes.tree import Allowance, Pieces

IMAGES = pytest.mark.skipif(bool(why := images.unavailable()), reason=f"volumes cannot be images: {why}")

WRITER = """
import sqlite3, sys
database = sqlite3.connect(sys.argv[1], isolation_level=None)
database.execute("pragma journal_mode = wal")
database.execute("pragma synchronous = full")
database.execute("create table if not exists rows (number integer primary key, text text)")
number = 0
while True:
    number += 1
    database.execute("insert into rows values (?, ?)", (number, "x" * 2000))
    print(number, flush=True)
"""


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """A volume with all kinds of files."""
    root = tmp_path / "volume"
    (root / "deep" / "deeper").mkdir(parents=True)
    (root / "empty").mkdir(mode=0o750)
    (root / "deep" / "deeper" / "file").write_bytes(os.urandom(PIECE + 1000))
    (root / "text").write_text("hello")
    (root / "text").chmod(0o640)
    os.utime(root / "text", ns=(5, 1_000_000_007))
    Path(os.fsdecode(os.fsencode(root) + b"/\xff odd\nname")).write_bytes(b"")
    (root / "link").symlink_to("/etc/passwd")
    (root / "deep" / "up").symlink_to("../..")
    os.link(root / "text", root / "same")
    os.mkfifo(root / "fifo")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(root / "socket"))
    with (root / "holes").open("wb") as file:
        file.truncate(4 * PIECE)
        file.seek(2 * PIECE)
        file.write(b"data")
    return root


def opened(path: Path) -> int:
    return os.open(path, os.O_RDONLY | os.O_DIRECTORY)


def scan(path: Path) -> Manifest:
    root = opened(path)
    try:
        return tree.scan(root, Allowance(1 << 30))
    finally:
        os.close(root)


def write(manifest: Manifest, source: Path, target: Path) -> None:
    """Make a copy of a volume by its manifest and pieces."""
    target.mkdir()
    ends = opened(source), opened(target)
    pieces = Pieces(ends[0], manifest)

    async def fetch(sha256: str) -> bytes:
        return pieces.read(sha256)

    try:
        asyncio.run(tree.write(manifest, ends[1], fetch))
    finally:
        for end in ends:
            os.close(end)


def copy(source: Path, target: Path) -> None:
    ends = opened(source), opened(target)
    try:
        tree.finish_copy(tree.copy(*ends, Allowance(1 << 30)), ends[1])
    finally:
        for end in ends:
            os.close(end)


def test_a_volume_is_made_again(made: Path, tmp_path: Path) -> None:
    manifest = scan(made)
    write(manifest, made, tmp_path / "again")
    assert scan(tmp_path / "again") == manifest
    names = {os.fsencode(path.relative_to(tmp_path / "again")) for path in (tmp_path / "again").rglob("*")}
    assert b"\xff odd\nname" in names
    assert not {b"fifo", b"socket"} & names
    assert (tmp_path / "again" / "link").readlink() == Path("/etc/passwd")
    found = (tmp_path / "again" / "text").stat()
    assert (found.st_mode & 0o7777, found.st_mtime_ns) == (0o640, 1_000_000_007)
    holes = (tmp_path / "again" / "holes").stat()
    assert holes.st_size == 4 * PIECE
    assert holes.st_blocks * 512 < 2 * PIECE
    assert next(file for file in manifest.files if file.path == b"holes").pieces[0] == HOLE


def test_a_copy_is_equal(made: Path, tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    copy(made, tmp_path / "copy")
    assert scan(tmp_path / "copy") == scan(made)
    holes = (tmp_path / "copy" / "holes").stat()
    assert holes.st_blocks * 512 < 2 * PIECE


def test_a_copy_follows_what_changes(made: Path, tmp_path: Path) -> None:
    """Files become folders and links, and the other way round; others grow, shrink, change and go."""
    (tmp_path / "copy").mkdir()
    copy(made, tmp_path / "copy")
    kept = (tmp_path / "copy" / "deep" / "deeper" / "file").stat()
    (made / "text").unlink()
    (made / "text").mkdir()
    (made / "text" / "inner").write_text("in it")
    shutil.rmtree(made / "empty")
    (made / "empty").symlink_to("text")
    (made / "link").unlink()
    (made / "link").write_text("no link")
    (made / "same").unlink()
    (made / "holes").write_bytes(bytes(PIECE) + b"shorter")
    copy(made, tmp_path / "copy")
    assert scan(tmp_path / "copy") == scan(made)
    found = (tmp_path / "copy" / "deep" / "deeper" / "file").stat()
    assert (found.st_ino, found.st_blocks) == (kept.st_ino, kept.st_blocks)


def test_a_file_without_data_is_copied_at_once(tmp_path: Path) -> None:
    """Only what holds data is read, and data that became a hole is freed in the copy."""
    volume, again = tmp_path / "volume", tmp_path / "copy"
    volume.mkdir()
    again.mkdir()
    file = volume / "sparse"
    file.write_bytes(os.urandom(3 * PIECE))
    copy(volume, again)
    with file.open("wb") as opened_:
        opened_.truncate(256 << 30)
        os.pwrite(opened_.fileno(), b"data", 200 << 30)
    ends = opened(volume), opened(again)
    try:
        tree.finish_copy(tree.copy(*ends, Allowance(0)), ends[1])  # whole, it would be too much
        manifest = tree.scan(ends[1], Allowance(0))
        assert manifest == tree.scan(ends[0], Allowance(0))
    finally:
        for end in ends:
            os.close(end)
    assert manifest.size == PIECE
    assert (again / "sparse").stat().st_size == 256 << 30
    assert (again / "sparse").stat().st_blocks * 512 <= PIECE


@pytest.mark.parametrize("read", [scan, lambda volume: copy(volume, volume.parent / "copy")])
def test_what_is_too_much_is_refused_early(tmp_path: Path, read: Callable[[Path], object]) -> None:
    """Before it is read: a node can make files of any size, and any number of links to one."""
    volume = tmp_path / "volume"
    volume.mkdir()
    (tmp_path / "copy").mkdir()
    with (volume / "file").open("wb") as file:
        file.truncate(4 << 40)
    with pytest.raises(SnapshotError, match="its files are larger than"):
        read(volume)
    (volume / "file").write_bytes(os.urandom(16 * MEGABYTE))
    for number in range(80):
        os.link(volume / "file", volume / f"link{number}")
    with pytest.raises(SnapshotError, match="each hard link counts"):
        read(volume)
    assert size_of(tmp_path / "copy") < (1 << 30) + 33 * MEGABYTE


def test_a_copy_ends_with_its_container(made: Path, tmp_path: Path) -> None:
    """Its file system stays mounted while it is read, and the next container waits."""
    (tmp_path / "copy").mkdir()
    ends = opened(made), opened(tmp_path / "copy")
    try:
        with pytest.raises(SnapshotError, match="its container ended"):
            tree.copy(*ends, Allowance(1 << 30, lambda: False))
    finally:
        for end in ends:
            os.close(end)


def test_a_wrong_piece_is_refused(made: Path, tmp_path: Path) -> None:
    manifest = scan(made)

    async def fetch(_: str) -> bytes:
        return b"hellO"

    (tmp_path / "again").mkdir()
    root = opened(tmp_path / "again")
    try:
        with pytest.raises(SnapshotError, match="is not what its hash says"):
            asyncio.run(tree.write(manifest, root, fetch))
    finally:
        os.close(root)


def test_a_file_that_changed_is_refused(made: Path) -> None:
    manifest = scan(made)
    (made / "text").write_text("HELLO")
    root = opened(made)
    try:
        with pytest.raises(SnapshotError, match="text changed while it was read"):
            Pieces(root, manifest).read(digest(b"hello").hex())
    finally:
        os.close(root)


def test_nothing_is_made_over_what_exists(tmp_path: Path) -> None:
    """Not through a link either, which something else has put there."""
    (tmp_path / "target").mkdir()
    (tmp_path / "target" / "file").symlink_to(tmp_path / "outside")
    root = opened(tmp_path / "target")
    entry = FileEntry(path=b"file", mode=0o644, modified_ns=0, size=0, pieces=())

    async def fetch(_: str) -> bytes:
        return b""

    try:
        with pytest.raises(FileExistsError):
            asyncio.run(tree.write(Manifest(entries=(entry,)), root, fetch))
    finally:
        os.close(root)
    assert not (tmp_path / "outside").exists()


@pytest.fixture
def attacked(tmp_path: Path) -> tuple[Path, Path, Callable[[], None]]:
    """A volume, a folder beside it, and what exchanges a folder of the volume for a link to that one."""
    volume, outside = tmp_path / "volume", tmp_path / "outside"
    for folder in (volume / "p", outside):
        folder.mkdir(parents=True)
    (volume / "p" / "file").write_text("of the node")
    (outside / "file").write_text("of the machine")
    (outside / "file").chmod(0o400)

    def swap() -> None:
        (volume / "p").rename(volume / "q")
        (volume / "p").symlink_to(outside)

    return volume, outside, swap


@pytest.mark.parametrize("step", [b"p", b"p/file"])
def test_a_copy_follows_no_folder_that_becomes_a_link(
    attacked: tuple[Path, Path, Callable[[], None]],
    step: bytes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A node may do that while its volume is copied, and root would read the machine's files."""
    volume, outside, swap = attacked
    walk = tree._walk

    def walk_and_swap(*args: Any) -> Iterator[tuple[bytes, os.stat_result]]:
        for path, found in walk(*args):
            if path == step and not (volume / "q").exists():
                swap()
            yield path, found

    monkeypatch.setattr(tree, "_walk", walk_and_swap)
    (tmp_path / "copy").mkdir()
    with contextlib.suppress(OSError, SnapshotError):
        copy(volume, tmp_path / "copy")
    copied = [path.read_text() for path in (tmp_path / "copy").rglob("*") if path.is_file()]
    assert "of the machine" not in copied
    assert (outside / "file").stat().st_mode & 0o777 == 0o400


def test_measuring_follows_no_folder_that_becomes_a_link(
    attacked: tuple[Path, Path, Callable[[], None]],
) -> None:
    volume, _, swap = attacked
    found = stats_below(volume)
    next(found)
    swap()
    assert list(found) == []
    assert size_of(volume) == len("of the node") + len(str(attacked[1]))


def test_nothing_is_made_below_a_link(tmp_path: Path) -> None:
    """Not even if the manifest says so."""
    (tmp_path / "target").mkdir()
    (tmp_path / "outside").mkdir()
    link = LinkEntry(path=b"p", target=os.fsencode(tmp_path / "outside"))
    file = FileEntry(path=b"p/file", mode=0o644, modified_ns=0, size=0, pieces=())
    root = opened(tmp_path / "target")

    async def fetch(_: str) -> bytes:
        return b""

    try:
        with pytest.raises(NotADirectoryError):
            asyncio.run(tree.write(Manifest(entries=(link, file)), root, fetch))
    finally:
        os.close(root)
    assert list((tmp_path / "outside").iterdir()) == []


def test_folders_that_are_nested_too_deep_are_refused(tmp_path: Path) -> None:
    """A descriptor is open for each of them."""
    folder = os.open(tmp_path, os.O_RDONLY)
    for _ in range(MAX_DEPTH + 2):
        os.mkdir("d", dir_fd=folder)
        inner = os.open("d", os.O_RDONLY, dir_fd=folder)
        os.close(folder)
        folder = inner
    os.close(folder)
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(OSError, match="nested more than 500 deep"):
        scan(tmp_path)
    assert "nested more than 500 deep" in measure(tmp_path).fault
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_what_a_node_made_unreadable_is_copied_and_stays_so(made: Path, tmp_path: Path) -> None:
    (made / "deep" / "deeper" / "file").chmod(0)
    (made / "deep").chmod(0)
    try:
        (tmp_path / "copy").mkdir()
        copy(made, tmp_path / "copy")
        copy(made, tmp_path / "copy")
        assert scan(tmp_path / "copy") == scan(made)
        assert (made / "deep").stat().st_mode & 0o777 == 0
    finally:
        for root in (made, tmp_path / "copy"):
            (root / "deep").chmod(0o700)
            (root / "deep" / "deeper" / "file").chmod(0o600)


def test_a_folder_of_a_container_is_not_reached_by_links(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    os.close(open_inside(os.getpid(), str(tmp_path / "real")))
    with pytest.raises(OSError, match=r"Not a directory|Too many levels"):
        open_inside(os.getpid(), str(tmp_path / "link"))


@IMAGES
def test_an_image_is_filled_and_read(made: Path, tmp_path: Path) -> None:
    image, point = tmp_path / "volume.img", tmp_path / "point"
    point.mkdir()
    images.make(image, 16 * MEGABYTE)
    manifest, source = scan(made), opened(made)
    pieces = Pieces(source, manifest)

    async def fetch(sha256: str) -> bytes:
        return pieces.read(sha256)

    root = open_image(image, point, read_only=False)
    os.rmdir("lost+found", dir_fd=root)
    asyncio.run(tree.write(manifest, root, fetch))
    assert list(point.iterdir()) == [], "only this program sees the mount"
    os.close(root)
    images.wait_until_unused(image, time.monotonic() + 30)
    root = open_image(image, point, read_only=True)
    assert tree.scan(root, Allowance(1 << 30)) == manifest
    with pytest.raises(OSError, match="Read-only"):
        os.mkdir("x", dir_fd=root)
    os.close(root)
    os.close(source)
    images.wait_until_unused(image, time.monotonic() + 30)


@IMAGES
def test_an_image_that_is_too_small_is_refused(made: Path, tmp_path: Path) -> None:
    (made / "large").write_bytes(os.urandom(8 * MEGABYTE))
    image, point = tmp_path / "volume.img", tmp_path / "point"
    point.mkdir()
    images.make(image, 4 * MEGABYTE)
    manifest, source = scan(made), opened(made)
    pieces = Pieces(source, manifest)

    async def fetch(sha256: str) -> bytes:
        return pieces.read(sha256)

    root = open_image(image, point, read_only=False)
    try:
        with pytest.raises(OSError, match="No space left"):
            asyncio.run(tree.write(manifest, root, fetch))
    finally:
        os.close(root)
        os.close(source)
    images.wait_until_unused(image, time.monotonic() + 30)


# Freezing


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A program that writes rows to a database, and tells the number of each when it is written."""
    (tmp_path / "volume").mkdir()
    argv = [sys.executable, "-c", WRITER, str(tmp_path / "volume" / "rows.sqlite")]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


def state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def told(writer: subprocess.Popen[str]) -> int:
    """Return a number that the writer has told."""
    assert writer.stdout is not None
    return int(writer.stdout.readline())


def test_a_database_is_copied_whole_while_it_is_written(
    writer: subprocess.Popen[str], tmp_path: Path
) -> None:
    for attempt in range(8):
        for _ in range(20):
            before = told(writer)
        work = tmp_path / "copy"
        work.mkdir(exist_ok=True)
        ends = opened(tmp_path / "volume"), opened(work)
        tree.copy(*ends, Allowance(1 << 30))
        with frozen(lambda: [writer.pid]):
            assert state(writer.pid) == "T"
            tree.copy(*ends, Allowance(1 << 30))
        for end in ends:
            os.close(end)
        shutil.copytree(work, tmp_path / f"copy{attempt}")
        database = sqlite3.connect(tmp_path / f"copy{attempt}" / "rows.sqlite")
        assert database.execute("pragma integrity_check").fetchone() == ("ok",)
        count, last = database.execute("select count(*), max(number) from rows").fetchone()
        database.close()
        assert count == last >= before
    assert state(writer.pid) != "T"


def test_a_killed_program_leaves_nothing_frozen(writer: subprocess.Popen[str]) -> None:
    told(writer)
    script = (
        "import sys, time\n"
        "from rce_container.volumes.freezing import frozen\n"
        f"with frozen(lambda: [{writer.pid}]):\n"
        "    print('frozen', flush=True)\n"
        "    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as freezing:
        assert freezing.stdout is not None
        assert freezing.stdout.readline() == "frozen\n"
        assert state(writer.pid) == "T"
        freezing.send_signal(signal.SIGKILL)
        freezing.wait()
    deadline = time.monotonic() + 60
    while state(writer.pid) == "T":
        assert time.monotonic() < deadline
        time.sleep(0.01)
    told(writer)


def test_a_frozen_program_that_ended_is_no_fault(writer: subprocess.Popen[str]) -> None:
    with frozen(lambda: [writer.pid]):
        writer.kill()
        writer.wait()
