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
    typer.echo(f"another machine needs these two and {folder.authority}; running programs reload them")


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME", help="As it was issued.")],
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
        " machines. A machine that was stolen needs a new secret too: rce secret new"
    )


@app.command("list")
def list_(certificates: Certificates = None) -> None:
    """List certificates, when they expire, and what was revoked."""
    folder = _folder(certificates)
    found = list(folder.all())
    if not found:
        typer.echo(f"rce certificate: no certificates in {folder.path}; run: rce certificate init", err=True)
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
    """List certificates, as ``list`` does."""
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
