"""Options of TLS for programs that read no settings file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Tls = Annotated[bool, typer.Option("--tls", help="Serve in TLS (docs/how-to/tls.md).")]
Certificates = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Folder with authority.pem, NAME.pem and NAME.key [STATE/certificates]."
    ),
]
CertificateName = Annotated[
    str, typer.Option("--certificate", metavar="NAME", help="The certificate to use of that folder.")
]
TlsCert = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Show this certificate, such as one of a public authority."),
]
TlsKey = Annotated[Path | None, typer.Option(metavar="FILE", help="The key of --tls-cert.")]
Authority = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        envvar="RCE_AUTHORITY",
        help="The engine's authority.pem, where its certificate is not of a public authority.",
    ),
]
