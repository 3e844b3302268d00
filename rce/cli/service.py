"""``rce install-service`` and ``rce uninstall-service``: the engine's programs as services of systemd."""

from __future__ import annotations

import grp
import json
import os
import pwd
import shlex
import shutil
import stat
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import platformdirs
import typer
from msgspec.structs import replace

from rce.config import ETCD_FILE, ConfigError, EngineSettings, default_secret_file, load_settings
from rce.services.units import SYSTEM_STATE, Role, Service, unit

SYSTEM_UNITS = Path("/etc/systemd/system")
SYSTEM_CONFIG = Path("/etc/rce")
USER = "rce"
HOMES = (Path("/home"), Path("/root"))
TEMPORARY = (Path("/tmp"), Path("/var/tmp"))  # noqa: S108 - nothing is written there
_PROGRAMS = {
    Role.ENGINE: ("rce", "up"),
    Role.MASTER: ("rce-master",),
    Role.ROBOT: ("rce-robot",),
    Role.CONTAINER: ("rce-container",),
}
_ETCD_PROGRAM = Path("/usr/bin/etcd")

UserUnit = Annotated[
    bool | None,
    typer.Option("--user/--system", help="Install for this user, or for the machine (default for root)"),
]


def install_service(
    role: Annotated[Role, typer.Argument(help="Program to run; engine: all in one (rce up).")],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(help="Arguments of the program, after --, such as: -- 10.0.0.1"),
    ] = None,
    *,
    user_unit: UserUnit = None,
    config: Annotated[
        Path | None, typer.Option(help="Settings file (default: engine.yaml in /etc/rce or ~/.config/rce)")
    ] = None,
    run_as: Annotated[
        str, typer.Option(help="User of master and robot services of the machine; created if missing.")
    ] = USER,
    show: Annotated[bool, typer.Option("--print", help="Print the unit, install nothing.")] = False,
) -> None:
    """Install a systemd service and start it."""
    system = is_system(user_unit)
    service = make_service(role, tuple(arguments or ()), system=system, config=config, run_as=run_as)
    if show:
        typer.echo(unit(service), nl=False)
        return
    install(service)


def uninstall_service(
    role: Annotated[Role, typer.Argument(help="Program of the unit.")], *, user_unit: UserUnit = None
) -> None:
    """Stop and remove a systemd service; keep state and settings."""
    system = is_system(user_unit)
    path = _units(system=system) / f"rce-{role}.service"
    if not path.exists():
        _fail(f"{path} does not exist: this service is not installed")
    _systemctl(system, ["disable", "--now", path.name])
    path.unlink()
    _systemctl(system, ["daemon-reload"])
    typer.echo(f"removed {path}")


def install(service: Service, *, start: bool = True) -> None:
    """Write the unit of a service, and start it; without systemd, print the commands for that.

    A master that runs by another unit is restarted; of other programs, the command for that is printed,
    since it interrupts containers or robots.

    Args:
        service: The service.
        start: Start it now, and not only with the machine.

    Raises:
        typer.Exit: What the service needs is missing, or it cannot be started.
    """
    check(service)
    if service.user:
        make_user(service.user)
        _open_state_folder(service)
        _open_secret(service)
        _open_certificates(service)
    folder = _units(system=service.system)
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / service.name, unit(service)
    is_changed = path.exists() and path.read_text(encoding="utf-8") != text
    was_active = is_changed and _is_active(service)
    path.write_text(text, encoding="utf-8")
    typer.echo(f"made {path}")
    _systemctl(service.system, ["daemon-reload"], ["enable", *(["--now"] if start else []), service.name])
    if not was_active:
        return
    if service.role is Role.MASTER and start:
        _systemctl(service.system, ["restart", service.name])
    else:
        words = shlex.join(_systemctl_words(service.system, ["restart", service.name]))
        typer.echo(f"{service.name} runs as it was started; to use the new unit: {words}")


def _open_state_folder(service: Service) -> None:
    """Let the service's user pass through the state folder, also if root's umask closed it."""
    paths = (service.state, *service.certificates)
    if not any(path is not None and path.is_relative_to(SYSTEM_STATE) for path in paths):
        return
    SYSTEM_STATE.mkdir(parents=True, exist_ok=True)
    mode = stat.S_IMODE(SYSTEM_STATE.stat().st_mode)
    if not mode & stat.S_IXOTH:
        SYSTEM_STATE.chmod(mode | stat.S_IXGRP | stat.S_IXOTH)


def _open_secret(service: Service) -> None:
    """Let the service's user read the secret by its group, and not write it: the file stays root's."""
    if service.secret is None:
        return
    _let_group(service.secret, service.user, stat.S_IROTH)
    if service.secret.parent == SYSTEM_CONFIG:
        _let_group(SYSTEM_CONFIG, service.user, stat.S_IXOTH)


def _open_certificates(service: Service) -> None:
    """Give the service's user its certificate, the key and the list of revoked ones, and their folder.

    The authority's key stays root's.

    Raises:
        typer.Exit: The user still may not read them.
    """
    if not service.certificates:
        return
    folder, user = service.certificates[0].parent, service.user
    for path in (folder, *service.certificates, folder / "revoked.pem"):
        _give(path, user)
    for path in service.certificates:
        if not _allows(path.stat(), user, stat.S_IROTH) or _first_closed(path, user) is not None:
            closed = _first_closed(path, user) or path
            _fail(
                f"user {user} may not read {path}: let it use {closed}, for example by chown {user} {closed}"
            )


def _give(path: Path, user: str) -> None:
    """Give a file or folder of root to a user who may not use it."""
    account = pwd.getpwnam(user)
    # The folder may be this user's already: nothing that the user links to changes.
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        found = os.fstat(descriptor)
        is_folder = stat.S_ISDIR(found.st_mode)
        is_alone = is_folder or (stat.S_ISREG(found.st_mode) and found.st_nlink == 1)
        bit = stat.S_IXOTH if is_folder else stat.S_IROTH
        if is_alone and found.st_uid == 0 and not _allows(found, user, bit):
            os.fchown(descriptor, account.pw_uid, account.pw_gid)
    finally:
        os.close(descriptor)


def _first_closed(path: Path, user: str) -> Path | None:
    """Return the first folder on the way to a path, from its end, that a user may not enter."""
    return next((each for each in path.parents if not _allows(each.stat(), user, stat.S_IXOTH)), None)


def _let_group(path: Path, user: str, bit: int) -> None:
    """Let a user's group use a file as ``bit`` would let all users.

    Raises:
        typer.Exit: Other users would be let too, or shut out.
    """
    found = path.stat()
    if _allows(found, user, bit):
        return
    group = grp.getgrgid(pwd.getpwnam(user).pw_gid)
    members = {*group.gr_mem, *(each.pw_name for each in pwd.getpwall() if each.pw_gid == group.gr_gid)}
    if others := sorted(members - {user}):
        _fail(
            f"user {user} may not read {path}; its group {group.gr_name} is not given access, since"
            f" {others[0]} is in it too: give --run-as a user that has a group of its own"
        )
    if found.st_gid not in (0, group.gr_gid) and found.st_mode & bit << 3:
        _fail(f"user {user} may not read {path}: add it to the group of this file, which others may use")
    os.chown(path, -1, group.gr_gid)
    path.chmod(stat.S_IMODE(found.st_mode) | bit << 3)


def _allows(found: os.stat_result, user: str, bit: int) -> bool:
    """Return whether a user may do with a file what ``bit`` lets all users do."""
    try:
        account = pwd.getpwnam(user)
    except KeyError:  # it is created later
        return bool(found.st_mode & bit)
    if found.st_uid == account.pw_uid:
        return bool(found.st_mode & bit << 6)
    in_group = found.st_gid in os.getgrouplist(user, account.pw_gid)
    return bool(found.st_mode & (bit << 3 if in_group else bit))


def _is_active(service: Service) -> bool:
    if not systemd_runs():
        return False
    argv = _systemctl_words(service.system, ["is-active", "--quiet", service.name])
    return subprocess.run(argv, check=False).returncode == 0  # noqa: S603 - fixed words and a unit's name


def make_service(
    role: Role, arguments: tuple[str, ...], *, system: bool, config: Path | None, run_as: str
) -> Service:
    """Return the service for a settings file."""
    folder = SYSTEM_CONFIG if system else platformdirs.user_config_path("rce")
    default = folder / "engine.yaml"
    file = default if config is None and default.exists() else config
    settings = _load(file)
    if role is Role.ETCD:
        state = SYSTEM_STATE if system else settings.state_dir
        return Service(
            role=role,
            program=Path(shutil.which("etcd") or _ETCD_PROGRAM),
            arguments=arguments or ("--config-file", str(state / ETCD_FILE)),
            system=system,
            user=run_as if system and run_as != "root" else "",
            state=state / "etcd",
        )
    program = Path(sys.executable).parent / _PROGRAMS[role][0]
    words = [*_PROGRAMS[role][1:]]
    if file is not None:
        words += ["--config", str(file.absolute())]
    if system and settings.state_dir == EngineSettings().state_dir:
        settings = replace(settings, state_dir=SYSTEM_STATE)
        words += ["--settings", json.dumps({"state_dir": str(SYSTEM_STATE)})]
    states = {
        Role.ENGINE: settings.state_dir,
        Role.MASTER: settings.master_state,
        Role.CONTAINER: settings.container_state,
    }
    user = run_as if system and role in (Role.MASTER, Role.ROBOT) and run_as != "root" else ""
    secret = (settings.secret_file or SYSTEM_CONFIG / "secret") if system and not settings.dev else None
    certificates = _certificates(settings, arguments) if system and role is not Role.ENGINE else ()
    needed = (*_needed(program), *((secret,) if secret is not None else ()), *certificates)
    return Service(
        role=role,
        program=program,
        arguments=(*words, *arguments),
        system=system,
        user=user,
        secret=secret,
        state=states.get(role),
        certificates=certificates,
        hide_homes=not any(path.is_relative_to(home) for path in needed for home in HOMES),
    )


def _certificates(settings: EngineSettings, arguments: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the files of TLS that a program reads by its settings and its arguments."""
    if not settings.tls.enabled and "--tls" not in arguments:
        return ()
    folder, name = settings.certificates, settings.tls.name
    words = [part for word in arguments for part in word.split("=", 1)]
    for option, value in pairwise(words):
        if option == "--certificates":
            folder = Path(value).absolute()
        elif option == "--certificate":
            name = value
    return folder / "authority.pem", folder / f"{name}.pem", folder / f"{name}.key"


def _load(file: Path | None) -> EngineSettings:
    try:
        return load_settings(file)
    except ConfigError as error:
        typer.echo(error, err=True)
        raise typer.Exit(2) from None


def is_system(user_unit: bool | None) -> bool:
    """Return whether services are the machine's; by default they are for root."""
    return os.geteuid() == 0 if user_unit is None else not user_unit


def _units(*, system: bool) -> Path:
    return SYSTEM_UNITS if system else platformdirs.user_config_path("systemd") / "user"


def check(service: Service) -> None:
    """Check what a service needs to start.

    Raises:
        typer.Exit: It is missing.
    """
    if service.role is Role.ETCD:
        _check_etcd(service)
        return
    if not service.program.exists():
        _fail(f"{service.program} is not installed; install RCE with the extra 'server'")
    hidden = service.system and service.role in (Role.MASTER, Role.ROBOT)
    if hidden and any(
        path.is_relative_to(folder) for path in _needed(service.program) for folder in TEMPORARY
    ):
        _fail(
            f"{service.program} cannot run as a service: services have a /tmp and a /var/tmp of their own;"
            " install RCE elsewhere (/usr/bin/python3 -m venv /opt/rce)"
        )
    closed = next(filter(None, map(_closed_folder, _needed(service.program))), None)
    if service.user and closed is not None:
        _fail(
            f"user {service.user} may not enter {closed}, which {service.program} needs: install RCE where"
            " every user may, with a Python that is there too (/usr/bin/python3 -m venv /opt/rce), or give"
            " --run-as root"
        )
    if service.secret is not None:
        _check_secret(service, service.secret, hidden=hidden)
    missing = next((path for path in service.certificates if not path.exists()), None)
    if missing is not None:
        where = f"--certificates {missing.parent}"
        _fail(
            f"the unit uses TLS, and {missing} is missing: copy it from the machine with the authority, or"
            f" make it there (rce certificate init {where}, rce certificate issue {missing.stem} {where})"
        )
    if not service.system and not default_secret_file().exists():
        typer.echo(f"note: {default_secret_file()} has no secret yet; create one with: rce secret new")


def _check_secret(service: Service, secret: Path, *, hidden: bool) -> None:
    if not secret.exists():
        _fail(
            f"the secret {secret} is missing: create it with `rce secret new {secret}`,"
            " or copy it from the master"
        )
    if hidden and any(secret.is_relative_to(folder) for folder in TEMPORARY):
        _fail(
            f"services have a /tmp and a /var/tmp of their own, so they do not see the secret {secret}:"
            f" move it to {SYSTEM_CONFIG}"
        )
    # The folder of settings is opened when the service is installed.
    path = SYSTEM_CONFIG if secret.parent == SYSTEM_CONFIG else secret
    closed = _first_closed(path, service.user) if service.user else None
    if closed is not None:
        _fail(
            f"user {service.user} may not enter {closed}, which the secret {secret} is in: move it to"
            f" {SYSTEM_CONFIG}, or give --run-as root"
        )


def _check_etcd(service: Service) -> None:
    if not service.program.exists():
        _fail("etcd is not installed; install release 3.4 or later (Debian: etcd-server)")
    config = Path(service.arguments[-1])
    if not config.exists():
        _fail(f"{config} is missing: rce cluster init and rce cluster join write it")


def _needed(program: Path) -> tuple[Path, ...]:
    """Return the folders of a program, its Python and this package."""
    return program, Path(sys.executable).resolve(), Path(sys.base_prefix), Path(__file__).resolve()


def _closed_folder(path: Path) -> Path | None:
    """Return the first folder on the way to a path that only its owner or group may enter."""
    return next((each for each in reversed(path.parents) if not each.stat().st_mode & stat.S_IXOTH), None)


def make_user(name: str) -> None:
    """Create the user of services if it is missing."""
    try:
        pwd.getpwnam(name)
    except KeyError:
        argv = [
            "useradd",
            "--system",
            "--user-group",
            "--no-create-home",
            "--shell",
            "/usr/sbin/nologin",
            name,
        ]
        done = subprocess.run(argv, check=False, capture_output=True, text=True)  # noqa: S603 - fixed words
        if done.returncode:
            _fail(f"cannot create the user {name}: {done.stderr.strip()}")
        typer.echo(f"created the user {name}")


def systemd_runs() -> bool:
    """Return whether systemd runs on this machine."""
    return Path("/run/systemd/system").is_dir() and shutil.which("systemctl") is not None


def _systemctl(system: bool, *commands: list[str]) -> None:
    """Run systemctl, or print the command if systemd does not run."""
    runs = systemd_runs()
    for command in commands:
        argv = _systemctl_words(system, command)
        if not runs:
            typer.echo(f"systemd does not run here; on the machine, run: {' '.join(argv)}")
        elif subprocess.run(argv, check=False).returncode:  # noqa: S603 - fixed words and a unit's name
            _fail(f"{' '.join(argv)} failed")


def _systemctl_words(system: bool, command: list[str]) -> list[str]:
    return ["systemctl", *([] if system else ["--user"]), *command]


def _fail(text: str) -> None:
    typer.echo(f"rce: {text}", err=True)
    raise typer.Exit(1)
