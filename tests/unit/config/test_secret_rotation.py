from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

import pytest

from rce.config.exceptions import SecretError
from rce.config.secret import new_secret, read_secret, retire_secrets, rotate_secret

if TYPE_CHECKING:
    from pathlib import Path


def test_both_secrets_are_accepted_until_the_old_one_is_retired(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    old = new_secret(file).reveal()
    used = read_secret(file)
    rotate_secret(file)
    new = used.reveal()
    assert new != old
    assert used.matches(old)
    assert used.matches(new)
    assert retire_secrets(file) == 1
    assert (used.matches(old), used.matches(new)) == (False, True)
    assert retire_secrets(file) == 0
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert [each.name for each in tmp_path.iterdir()] == ["secret"]


def test_second_rotation_waits_for_the_end_of_the_first(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    new_secret(file)
    rotate_secret(file)
    with pytest.raises(SecretError, match="rce secret retire"):
        rotate_secret(file)


def test_refused_secret_gives_way_to_the_other(tmp_path: Path) -> None:
    """A task set whose file is changed before the master's shows the old one, too."""
    file = tmp_path / "secret"
    old = new_secret(file).reveal()
    rotate_secret(file)
    used = read_secret(file)
    new = used.reveal()
    assert used.was_refused(new)
    assert used.reveal() == old
    assert not used.was_refused(old), "both were refused"
    assert used.reveal() == new


@pytest.mark.parametrize("text", ["", "short", "good enough\nbäd one here"])
def test_file_that_went_bad_changes_nothing(tmp_path: Path, text: str) -> None:
    file = tmp_path / "secret"
    old = new_secret(file).reveal()
    used = read_secret(file)
    file.write_text(text)
    assert used.matches(old)
    file.unlink()
    assert used.reveal() == old
    with pytest.raises(SecretError):
        read_secret(file)


def test_file_is_read_once_its_permissions_are_repaired(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file, other = tmp_path / "secret", tmp_path / "other"
    old = new_secret(file).reveal()
    used = read_secret(file)
    new = new_secret(other).reveal()
    other.chmod(0o644)
    other.replace(file)
    for _ in range(3):
        assert (used.matches(new), used.matches(old)) == (False, True)
    assert caplog.text.count(f"run: chmod 600 {file}") == 1
    file.chmod(0o600)
    assert (used.matches(new), used.matches(old)) == (True, False)


@pytest.mark.needs("root")
def test_advice_keeps_a_services_file_readable(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    new_secret(file)
    os.chown(file, 0, 4711)
    file.chmod(0o644)
    with pytest.raises(SecretError, match="chmod 640"):
        read_secret(file)
