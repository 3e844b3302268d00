"""``rce certificate``: a certificate authority of the engine, certificates for machines and robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from rce.cli.options import Certificates
from rce.tls import CertificateError
from rce.tls.authority import AUTHORITY_DAYS, CERTIFICATE_DAYS, RENEWAL_DAYS, Details
from rce.tls.choice import default_folder
from rce.tls.folder import AUTHORITY, CertificateFolder

T = TypeVar("T")
app = typer.Typer(no_args_is_help=True, help="Manage the engine's certificates.")


@app.command()
def init(
    certificates: Certificates = None,
    days: Annotated[float, typer.Option(help="Validity of the authority, days.", min=1.0)] = AUTHORITY_DAYS,
) -> None:
    """Create a certificate authority for this engine."""
    folder = _folder(certificates)
    _do(lambda: folder.make_authority(days))
    typer.echo(f"created {folder.authority}: copy it to all machines that connect")
    typer.echo(f"created {folder.key(AUTHORITY)}: it signs certificates; keep it on this machine, and secret")


@app.command()
def issue(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a machine, or engine.")],
    host: Annotated[
        list[str] | None,
        typer.Option(
            help="Host name or IP address in the certificate; may be repeated (default: as before, or NAME)."
        ),
    ] = None,
    certificates: Certificates = None,
    days: Annotated[
        float, typer.Option(help="Validity of the certificate, days.", min=0.01)
    ] = CERTIFICATE_DAYS,
) -> None:
    """Issue or renew a certificate."""
    folder = _folder(certificates)
    details = _do(lambda: folder.issue(name, host or (), days))
    typer.echo(
        f"created {folder.certificate(name)} and {folder.key(name)}: for {', '.join(details.hosts)},"
        f" until {details.expires:%Y-%m-%d}"
    )
    typer.echo(
        f"copy both and {folder.authority} to the machine that needs them; running programs reload them"
    )


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the certificates.")],
    certificates: Certificates = None,
) -> None:
    """Revoke all certificates of a name."""
    folder = _folder(certificates)
    added = _do(lambda: folder.revoke(name))
    if not added:
        typer.echo(f"the certificates of {name} were revoked before")
        return
    serials = ", ".join(f"{one.serial:x}" for one in added)
    typer.echo(f"revoked {name} (serial number {serials}) in {folder.revoked}")
    typer.echo(
        "a master that uses this folder refuses it from now on; copy the file to the folders of other"
        " machines. If the machine was stolen, replace the secret too: rce secret rotate"
    )


@app.command("list")
def list_(certificates: Certificates = None) -> None:
    """List certificates with expiry and revocation."""
    folder = _folder(certificates)
    found = list(folder.all())
    if not found:
        typer.echo(
            f"rce certificate: no certificates in {folder.path}; first run: rce certificate init",
            err=True,
        )
        raise typer.Exit(1)
    revoked = {one.serial: one.since for one in _do(folder.revocations)}
    owners = _do(folder.owners)
    here: set[int] = set()
    rows: list[tuple[str, str, str, str]] = []
    for name, details in found:
        if isinstance(details, str):
            rows.append((name, "-", "unreadable", details))
            continue
        here.add(details.serial)
        hosts = "(authority)" if details.is_authority else ", ".join(details.hosts) or "-"
        since = revoked.get(details.serial)
        state = _state(details) if since is None else f"revoked {since:%Y-%m-%d}"
        rows.append((name, f"{details.expires:%Y-%m-%d}", state, hosts))
    for serial, since in revoked.items():
        if serial not in here:
            row = owners.get(serial, "-"), "-", f"revoked {since:%Y-%m-%d}", f"(serial number {serial:x})"
            rows.append(row)
    width = max(len("NAME"), *(len(row[0]) for row in rows))
    for name, expires, state, hosts in (("NAME", "EXPIRES", "STATE", "HOSTS"), *rows):
        typer.echo(f"{name:<{width}}  {expires:<10}  {state:<18}  {hosts}")


@app.command(hidden=True)
def show(certificates: Certificates = None) -> None:
    """List certificates, same as ``list``."""
    list_(certificates)


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
