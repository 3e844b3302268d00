"""The documentation's site: broken links fail its build, and nothing in it comes from the network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tools.docs_files import in_site

ROOT = Path(__file__).parents[3]
GOOD = "[page](other.md#a-part), [`name`][other]\n"


def build(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    """Build two pages by the command of ``make docs``, with this project's rules for links."""
    recipe = re.search(r"^\t.* -m (mkdocs build.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert recipe is not None
    config = re.search(r"^validation:\n(?: .*\n)+", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert config is not None
    (folder / "docs").mkdir()
    (folder / "docs/index.md").write_text(text)
    (folder / "docs/other.md").write_text("# Other\n\n## A part\n")
    settings = {"site_name": "x", "plugins": ["autorefs"], "theme": "mkdocs", **yaml.safe_load(config[0])}
    (folder / "mkdocs.yml").write_text(yaml.safe_dump(settings))
    return subprocess.run(
        [sys.executable, "-m", *recipe[1].split()], cwd=folder, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_a_site_without_broken_links_is_built(tmp_path: Path) -> None:
    done = build(tmp_path, GOOD)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site/index.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    "broken",
    ["[page](nothing.md)", "[part](other.md#no-part)", "[`name`][no.such.name]", "[file](../no/file.py)"],
)
def test_a_broken_link_fails_the_build(tmp_path: Path, broken: str) -> None:
    done = build(tmp_path, f"{GOOD}\n{broken}\n")
    assert done.returncode != 0
    assert "WARNING" in done.stderr


FLEET, SHARE = "reference/fleet.md", "files/rce_fleet/share/README.md"


@pytest.mark.parametrize(
    ("source", "link", "place"),
    [
        (FLEET, "../../README.md", "files/README.md"),
        (FLEET, "../../configs/engine.yaml", "files/configs/engine.yaml"),
        (FLEET, "../architecture.md", ""),
        (FLEET, "../../no/such.py", ""),
        (FLEET, "../../../elsewhere.md", ""),
        (SHARE, "../../docs/reference/fleet.md", FLEET),
        (SHARE, "msg/FleetState.msg", "files/rce_fleet/share/msg/FleetState.msg"),
        (SHARE, "../../docs/no-such-page.md", ""),
    ],
)
def test_linked_files_have_a_place_in_the_site(source: str, link: str, place: str) -> None:
    assert in_site(source, link) == place


def test_the_menu_has_every_page() -> None:
    menu = re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    pages = [str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")]
    assert sorted(menu) == sorted(pages), "put it under nav in mkdocs.yml"


def test_the_site_asks_no_other_host() -> None:
    """Fonts, scripts and styles come with the theme; only links may lead elsewhere."""
    text = (ROOT / "mkdocs.yml").read_text()
    assert "font: false" in text
    assert "extra_javascript" not in text
    assert "extra_css" not in text
    assert "http" not in text
