"""Errors of certificates."""

from __future__ import annotations


class CertificateError(Exception):
    """A certificate or its key cannot be made, read or used; the text says which and what to do."""
