"""Keys, signatures, versions, and what a requirements.txt may ask for."""

from __future__ import annotations

import random

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from rce.model.names import VERSION_PATTERN, is_version, newest, split_package, version_key
from rce.packages.exceptions import BadKeyError, BadSignatureError
from rce.packages.requirements import read_requirements
from rce.packages.signing import SigningKey, key_id, statement, verify

SIGNED = statement("anna", "nav", "1.0", "0" * 64)


def test_a_signature_is_of_one_key_and_one_statement() -> None:
    key = SigningKey.generate()
    signature = key.sign(SIGNED)
    verify(key.public, signature, SIGNED)
    others = [
        statement("eve", "nav", "1.0", "0" * 64),
        statement("anna", "nav2", "1.0", "0" * 64),
        statement("anna", "nav", "1.1", "0" * 64),
        statement("anna", "nav", "1.0", "1" * 64),
    ]
    for other in others:
        with pytest.raises(BadSignatureError, match=key_id(key.public)):
            verify(key.public, signature, other)
    for wrong in ("", "00", "zz" * 64, signature[:-2], signature + "00", "é"):
        with pytest.raises(BadSignatureError):
            verify(key.public, wrong, SIGNED)
    with pytest.raises(BadSignatureError):
        verify(SigningKey.generate().public, signature, SIGNED)


@pytest.mark.parametrize("key", ["", "00", "0" * 63, "zz" * 32, "0" * 66, "é" * 64])
def test_what_is_no_key(key: str) -> None:
    with pytest.raises(BadKeyError):
        verify(key, "0" * 128, SIGNED)
    with pytest.raises(BadKeyError):
        key_id(key)


def test_a_key_survives_its_file() -> None:
    key = SigningKey.generate()
    assert SigningKey.from_pem(key.to_pem()).public == key.public
    locked = Ed25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(b"password"),
    )
    other = X25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    for text in (b"", b"nonsense", locked, other):
        with pytest.raises(BadKeyError):
            SigningKey.from_pem(text)


def test_versions_are_ordered_as_people_count() -> None:
    ordered = [
        *("0.0-alpha", "1.0-1", "1.0-2", "1.0-10", "1.0-a", "1.0-a.1", "1.0-rc1", "9.0-rc1"),
        *("0.1", "0.9", "0.10", "1", "1.0.1", "1.2", "1.10", "2.0.0", "10"),
    ]
    shuffled = ordered[:]
    random.Random(4).shuffle(shuffled)
    assert sorted(shuffled, key=version_key) == ordered
    assert newest(shuffled, lambda version: version) == "10"
    assert newest(["1.0-rc1", "1.0-rc2"], lambda version: version) == "1.0-rc2"
    assert newest([], lambda version: version) is None


@given(st.from_regex(VERSION_PATTERN, fullmatch=True).filter(is_version))
def test_every_version_can_be_ordered_and_put_into_a_path(version: str) -> None:
    assert version_key(version) == version_key(version)
    assert "/" not in version
    assert split_package(f"nav@{version}") == ("nav", version)


@pytest.mark.parametrize(
    "text", ["", "v1", "1.", ".1", "1..2", "1.2.3.4.5", "1-", "1.0-a..b", "1.0+x", "1\n"]
)
def test_what_is_no_version(text: str) -> None:
    assert not is_version(text)


def test_requirements_that_are_taken() -> None:
    text = (
        "six\n"
        "numpy >= 1.26, < 3  # arrays\n"
        "\n# nothing\n"
        "requests[security,socks]~=2.31 ; python_version < '3.13' and sys_platform == \"linux\"\n"
        "attrs==23.1.0 \\\n"
        "    --hash=sha256:0123456789abcdef \\\n"
        "    --hash=sha256:fedcba9876543210\n"
        "old (>=1.0)\n"
    )
    found = read_requirements(text)
    assert found.faults == ()
    assert len(found.lines) == 5
    assert found.lines[3].count("--hash=") == 2


@pytest.mark.parametrize(
    "line",
    [
        *("-e .", "-r other.txt", "--index-url https://evil", "./wheel.whl", "/etc/x", "file:///etc/x"),
        *("git+https://evil/x", "x @ https://evil/x.whl", "https://evil/x.whl", "x --global-option=y"),
        *("x;--pre", "x --hash=md5:00", "x y", "x==1 --hash=sha256:zz", "x $(rm)", "-x"),
        "a" * 50_000 + "@" + " " * 50_000 + "!",
    ],
)
def test_requirements_that_are_not(line: str) -> None:
    found = read_requirements(f"six\n{line}\n")
    assert found.lines == ("six",)
    assert len(found.faults) == 1
    assert "line 2" in found.faults[0]
