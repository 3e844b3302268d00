"""Archives that somebody made to do harm, and that what is packed comes out as it went in."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import stat
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.packages.archive import ArchiveWriter, read_archive
from rce.packages.contents import inspect
from rce.packages.exceptions import BadArchiveError
from rce.packages.limits import ArchiveLimits
from rce.packages.tree import Entry, Kind, Tree
from rce.packages.unpacking import unpack

MANIFEST = b"name: nav\nversion: '1.0'\n"
END = bytes(1024)
HUGE = (1 << 33) - 1
"""All that the header of a file can say."""


def header(name: str, size: int = 0, **fields: object) -> bytes:
    info = tarfile.TarInfo(name)
    info.size = size
    for key, value in fields.items():
        setattr(info, key, value)
    return info.tobuf(tarfile.USTAR_FORMAT, "utf-8", "strict")


def file(name: str, data: bytes = b"", **fields: object) -> bytes:
    return header(name, len(data), **fields) + data + bytes(-len(data) % 512)


def folder(name: str, size: int = 0, mode: int = 0o755) -> bytes:
    return header(name, size, type=tarfile.DIRTYPE, mode=mode)


def link(name: str, target: str) -> bytes:
    return header(name, type=tarfile.SYMTYPE, mode=0o777, linkname=target)


START = folder("nav") + file("nav/package.yaml", MANIFEST)


def on_disk(data: bytes) -> BinaryIO:
    opened = tempfile.TemporaryFile()  # noqa: SIM115 - for its user to close
    opened.write(data)
    opened.seek(0)
    return opened


def unpacked(data: bytes, into: Path, limits: ArchiveLimits | None = None) -> Tree:
    with on_disk(data) as opened:
        tree, _ = unpack(opened, into, limits or ArchiveLimits())
    return tree


def test_a_plain_archive_is_unpacked_read_only_for_everybody(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        data = START + link("nav/run", "run.py") + file("nav/run.py", b"x" * 700, mode=0o755) + END
        tree = unpacked(gzip.compress(data), tmp_path)
    finally:
        os.umask(before)
    assert list(tree.entries) == ["nav", "nav/package.yaml", "nav/run", "nav/run.py"]
    assert (tmp_path / "nav" / "run").read_bytes() == b"x" * 700
    modes = {path.name: stat.S_IMODE(path.lstat().st_mode) for path in (tmp_path / "nav").iterdir()}
    assert (modes["package.yaml"], modes["run.py"]) == (0o444, 0o555)
    assert stat.S_IMODE((tmp_path / "nav").stat().st_mode) == 0o755


HOSTILE: dict[str, tuple[bytes, str]] = {
    "above": (START + file("nav/../../evil") + END, "plain"),
    "absolute": (START + file("/etc/evil") + END, "plain"),
    "beside": (START + file("other/evil") + END, "outside of the folder"),
    "link out": (START + link("nav/x", "../../etc/passwd") + END, "out of the package"),
    "absolute link": (START + link("nav/x", "/etc/passwd") + END, "must be relative"),
    "link nowhere": (START + link("nav/x", "y") + END, "not in the package"),
    "link loop": (START + link("nav/x", "y") + link("nav/y", "x") + END, "too many links"),
    "write through a link": (START + link("nav/x", ".") + file("nav/x/evil") + END, "in no folder"),
    "link through a link": (
        START
        + b"".join([folder("nav/q"), folder("nav/q/r"), link("nav/q/r/up", "../..")])
        + link("nav/z", "q/r/up/../x")
        + END,
        "which is not a folder",
    ),
    "hard link": (START + header("nav/x", type=tarfile.LNKTYPE, linkname="nav/y") + END, "only files"),
    "device": (START + header("nav/x", type=tarfile.CHRTYPE, devmajor=1, devminor=3) + END, "only files"),
    "pipe": (START + header("nav/x", type=tarfile.FIFOTYPE) + END, "only files"),
    "sparse": (START + header("nav/x", type=tarfile.GNUTYPE_SPARSE) + END, "only files"),
    "extended header": (START + header("nav/x", size=HUGE, type=tarfile.XHDTYPE) + END, "only files"),
    "long name": (START + header("nav/x", size=HUGE, type=tarfile.GNUTYPE_LONGNAME) + END, "only files"),
    "setuid": (START + file("nav/x", mode=0o4755) + END, "a mode"),
    "sticky folder": (START + folder("nav/x", mode=0o1777) + END, "a mode"),
    "owner": (START + file("nav/x", uid=1000) + END, "an owner"),
    "owner's name": (START + file("nav/x", uname="root") + END, "an owner"),
    "time": (START + file("nav/x", mtime=5) + END, "a time"),
    "twice": (START + file("nav/package.yaml", b"name: evil\n") + END, "comes twice"),
    "order": (folder("nav") + file("nav/b") + file("nav/a") + END, "out of order"),
    "no parent": (START + file("nav/x/y") + END, "in no folder"),
    "file as folder": (START + file("nav/x") + file("nav/x/y") + END, "in no folder"),
    "no folder first": (file("nav") + END, "the first entry"),
    "folder with a size": (folder("nav", size=512) + bytes(512) + END, "a size"),
    "empty": (END, "empty"),
    "no end": (START, "ends too early"),
    "cut": (START + header("nav/x", 5000) + bytes(100), "ends too early"),
    "something behind": (START + END + b"evil", "behind the last entry"),
    "more zeros": (START + END + bytes(512), "behind the last entry"),
    "smuggled": (START + header("nav/x", 5) + b"12345" + b"evil" + bytes(503) + END, "between two entries"),
    "no tar": (b"evil" * 1000, "not an archive"),
    "unprintable": (START + file("nav/a\x1b[2J") + END, "cannot be printed"),
    "no manifest": (folder("nav") + file("nav/x") + END, "there is no package.yaml"),
    "another name": (folder("nav") + file("nav/package.yaml", b"name: evil\n") + END, "its folder is 'nav'"),
    "large manifest": (folder("nav") + file("nav/package.yaml", b"#" * 70000) + END, "than 65536 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_archives_are_refused(name: str, tmp_path: Path) -> None:
    data, text = HOSTILE[name]
    packed = gzip.compress(data)
    with on_disk(packed) as opened, pytest.raises(BadArchiveError, match=text):
        inspect(opened)
    target = tmp_path / "deep" / "target"
    target.mkdir(parents=True)
    try:
        unpacked(packed, target)
    except BadArchiveError:
        pass
    else:
        assert "manifest" in name or name == "another name", "only those are not the unpacking's concern"
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["target"]
    assert not list(tmp_path.rglob("evil"))


def test_a_bomb_is_stopped_early(tmp_path: Path) -> None:
    size = 64 << 20
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb", mtime=0) as opened:
        opened.write(START + header("nav/x", size))
        for _ in range(64):
            opened.write(bytes(1 << 20))
        opened.write(END)
    limits = ArchiveLimits(free=1 << 20)
    with pytest.raises(BadArchiveError, match="unpacks to more than"):
        unpacked(packed.getvalue(), tmp_path, limits)
    written = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert written < 16 << 20
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(BadArchiveError, match="its files have more than"):
        unpacked(packed.getvalue(), other, ArchiveLimits(unpacked=1 << 20))
    assert not (other / "nav" / "x").exists()


def test_limits_of_the_archive_itself(tmp_path: Path) -> None:
    many = gzip.compress(START + b"".join(file(f"nav/x{number:03}") for number in range(100)) + END)
    with pytest.raises(BadArchiveError, match="more than 50 files"):
        unpacked(many, tmp_path, ArchiveLimits(entries=50))
    with pytest.raises(BadArchiveError, match="the archive has more than"):
        unpacked(many, tmp_path, ArchiveLimits(archive=100))


@pytest.mark.parametrize(
    "spoil", [lambda d: d[:-20], lambda d: d[:40] + b"\xff" + d[41:], lambda d: b"x" + d]
)
def test_a_damaged_archive_is_told(spoil: Callable[[bytes], bytes], tmp_path: Path) -> None:
    with pytest.raises(BadArchiveError):
        unpacked(spoil(gzip.compress(START + END)), tmp_path)


names = st.text(st.characters(codec="utf-8", exclude_characters="/"), min_size=1, max_size=8).filter(
    lambda text: text.isprintable() and text not in (".", "..")
)
contents = st.binary(max_size=2000)
trees = st.recursive(
    st.dictionaries(names, contents, max_size=4),
    lambda inner: st.dictionaries(names, contents | inner, max_size=4),
    max_leaves=12,
)


def entries_of(tree: dict[str, Any], path: str) -> Iterator[tuple[Entry, bytes]]:
    yield Entry(path=path, kind=Kind.FOLDER), b""
    for name, value in tree.items():
        if isinstance(value, bytes):
            executable = len(value) % 2 == 1
            yield Entry(path=f"{path}/{name}", kind=Kind.FILE, size=len(value), executable=executable), value
        else:
            yield from entries_of(value, f"{path}/{name}")


@given(trees)
def test_what_is_packed_comes_out_as_it_went_in(tree: dict[str, Any]) -> None:
    entries = sorted(entries_of(tree, "nav"), key=lambda pair: pair[0].parts)
    packed = io.BytesIO()
    with ArchiveWriter(packed) as archive:
        for entry, data in entries:
            archive.add(entry, [data] if data else [])
    seen: list[tuple[Entry, bytes]] = []
    with on_disk(packed.getvalue()) as opened:
        read_archive(opened, lambda entry, data: seen.append((entry, b"".join(data))))
    assert seen == entries


@given(st.binary(max_size=300), st.integers(0, 3000))
def test_no_garbage_does_anything_but_be_refused(garbage: bytes, at: int) -> None:
    plain = START + file("nav/run.py", b"x" * 600) + END
    at = min(at, len(plain))
    data = plain[:at] + garbage + plain[at + len(garbage) :]
    with tempfile.TemporaryDirectory() as scratch:
        target = Path(scratch) / "target"
        target.mkdir()
        with contextlib.suppress(BadArchiveError):
            unpacked(gzip.compress(data, 1), target)
        assert [path.name for path in Path(scratch).iterdir()] == ["target"]
        for path in target.rglob("*"):
            assert not path.lstat().st_mode & (stat.S_ISUID | stat.S_ISGID)


def test_the_digest_does_not_depend_on_the_compression(tmp_path: Path) -> None:
    data = START + END
    digests = set()
    for level in (1, 9):
        with on_disk(gzip.compress(data, level)) as opened:
            digests.add(inspect(opened).digest)
    assert len(digests) == 1
