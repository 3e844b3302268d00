"""What is taken for the name of an image."""

from __future__ import annotations

import pytest

from rce_container.runtimes.podman import is_image_name


@pytest.mark.parametrize(
    "text",
    [
        "debian",
        "debian:12",
        "localhost/mine:1",
        "registry.example.org:5000/group/thing:v1.2",
        "quay.io/a/b@sha256:" + "0" * 64,
        "docker.io/library/oci:1",
        "fa09c784942d",
    ],
)
def test_names_of_images(text: str) -> None:
    assert is_image_name(text)


@pytest.mark.parametrize(
    "text",
    [
        *("", " ", "-v", "--privileged", "a b", ":x", "a:b:c", "../x", "/x", "a//b", "a\nb", "b@sha256:12"),
        *("oci:x", "oci:1", "dir:80/x", "dir:/", "docker-archive:/etc/passwd", "tarball:x", "sif:x"),
        "containers-storage:debian",
    ],
)
def test_what_is_none(text: str) -> None:
    assert not is_image_name(text)
