"""Masters know each other's requests while the engine's secret changes."""

from __future__ import annotations

import shutil
from itertools import permutations
from typing import TYPE_CHECKING

from rce.config import Secret
from rce.config.secret import new_secret, read_secret, retire_secrets, rotate_secret
from rce_master.http.forwarded import ForwardingKey
from rce_master.leadership.request_key import RequestKey

if TYPE_CHECKING:
    from pathlib import Path


def knows(reader: Secret, writer: Secret) -> bool:
    """Whether a master takes what another one forwards, and what another one asks for as the leader."""
    forwarded = ForwardingKey(reader).read(ForwardingKey(writer).sign("10.0.0.7", 4), 4)
    value = RequestKey(writer).sign("PUT", "/archives/a?b=c", 4)
    asked = RequestKey(reader).read(value, "PUT", "/archives/a?b=c")
    assert (forwarded is None) == (asked is None)
    assert RequestKey(reader).read(value, "DELETE", "/archives/a?b=c") is None
    return (forwarded, asked) == ("10.0.0.7", 4)


def test_masters_know_each_other_at_each_step_of_a_rotation(tmp_path: Path) -> None:
    file, far = tmp_path / "secret", tmp_path / "secret of another machine"
    old = Secret(new_secret(file).reveal())
    shutil.copy(file, far)
    masters = [read_secret(file), read_secret(far)]
    rotate_secret(file)
    masters.append(read_secret(file))
    assert all(knows(reader, writer) for reader, writer in permutations(masters, 2))
    shutil.copy(file, far)
    assert retire_secrets(file) == 1
    assert all(knows(reader, writer) for reader, writer in permutations(masters, 2))
    assert not knows(masters[0], old)
    assert retire_secrets(far) == 1
    assert not any(knows(reader, old) for reader in masters)
    assert not any(knows(old, writer) for writer in masters)


def test_a_proof_for_one_purpose_proves_nothing_for_another() -> None:
    secret = Secret("the secret of this engine")
    proof = secret.sign("one", "text")
    assert secret.has_signed("one", "text", f"x,{proof}")
    for purpose, text, given in (("two", "text", proof), ("one", "other", proof), ("one", "text", "")):
        assert not secret.has_signed(purpose, text, given)
