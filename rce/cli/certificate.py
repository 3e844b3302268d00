"""``rce certificate``: the engine's own authority, and certificates for its machines and robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from rce.cli.tls_options import Certificates
from rce.tls.authority import AUTHORITY_DAYS, CERTIFICATE_DAYS, RENEWAL_DAYS, Details
from rce.tls.choice import default_folder
from rce.tls.exceptions import CertificateError
from rce.tls.folder import AUTHORITY, CertificateFolder

T = TypeVar("T")
app = typer.Typer(no_args_is_help=True, help="Make and show the engine's certificates.")


@app.command()
def init(
    certificates: Certificates = None,
    days: Annotated[float, typer.Option(help="How long the authority is valid.", min=1.0)] = AUTHORITY_DAYS,
) -> None:
    """Make an authority for this engine."""
    folder = _folder(certificates)
    _do(lambda: folder.make_authority(days))
    typer.echo(f"made {folder.authority}: copy it to the machines that connect")
    typer.echo(f"made {folder.key(AUTHORITY)}: it signs certificates; keep it here and secret")


@app.command()
def issue(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A robot, a machine, or engine.")],
    host: Annotated[
        list[str] | None,
        typer.Option(help="Name or IP address that it is good for; may be repeated [as before, or NAME]."),
    ] = None,
    certificates: Certificates = None,
    days: Annotated[float, typer.Option(help="How long it is valid.", min=0.01)] = CERTIFICATE_DAYS,
) -> None:
    """Issue a certificate, or renew one."""
    folder = _folder(certificates)
    details = _do(lambda: folder.issue(name, host or (), days))
    typer.echo(
        f"made {folder.certificate(name)} and {folder.key(name)}: for {', '.join(details.hosts)},"
        f" until {details.expires:%Y-%m-%d}"
    )
    typer.echo(f"another machine needs these two and {folder.authority}; programs that run load them anew")


@app.command()
def show(certificates: Certificates = None) -> None:
    """List certificates and when they expire."""
    folder = _folder(certificates)
    found = list(folder.all())
    if not found:
        typer.echo(f"rce certificate: no certificates in {folder.path}; run: rce certificate init", err=True)
        raise typer.Exit(1)
    width = max(len("NAME"), *(len(name) for name, _ in found))
    typer.echo(f"{'NAME':<{width}}  {'EXPIRES':<10}  {'STATE':<16}  HOSTS")
    for name, details in found:
        if isinstance(details, str):
            typer.echo(f"{name:<{width}}  {'-':<10}  {'unreadable':<16}  {details}")
            continue
        hosts = "(authority)" if details.is_authority else ", ".join(details.hosts) or "-"
        typer.echo(f"{name:<{width}}  {details.expires:%Y-%m-%d}  {_state(details):<16}  {hosts}")


def _state(details: Details) -> str:
    left = details.days_left()
    if left <= 0:
        return "expired"
    return f"renew, {left:.0f} days" if left <= RENEWAL_DAYS else f"{left:.0f} days left"


def _folder(given: Path | None) -> CertificateFolder:
    return CertificateFolder((given or default_folder()).absolute())


def _do(work: Callable[[], T]) -> T:
    try:
        return work()
    except CertificateError as error:
        typer.echo(f"rce certificate: {error}", err=True)
        raise typer.Exit(1) from error
