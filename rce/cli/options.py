"""Options that several programs have."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rce.config import EngineSettings

Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log more: --log-level debug.")]

# TLS, for programs whose settings are their options

Tls = Annotated[bool, typer.Option("--tls", help="Serve with TLS (docs/how-to/tls.md).")]
Certificates = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Folder with authority.pem, NAME.pem and NAME.key [STATE/certificates]."
    ),
]
CertificateName = Annotated[
    str, typer.Option("--certificate", metavar="NAME", help="Name of the certificate in that folder.")
]
TlsCert = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Certificate file to use instead, such as one of a public authority."),
]
TlsKey = Annotated[Path | None, typer.Option(metavar="FILE", help="Key file of --tls-cert.")]
Authority = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        envvar="RCE_AUTHORITY",
        help="The engine's authority.pem, unless its certificate is of a public authority.",
    ),
]


def tls_of(settings: EngineSettings) -> dict[str, Any]:
    """Return the values of these options in the settings file's section ``tls``."""
    tls = settings.tls
    found = {
        "tls": tls.enabled,
        "certificates": str(settings.certificates),
        "certificate": tls.name,
        "tls_cert": tls.cert and str(tls.cert),
        "tls_key": tls.key and str(tls.key),
    }
    return {name: value for name, value in found.items() if value is not None}
