"""``rce-master``: the Master Task Set as a program."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
import uvloop

from rce.config.exceptions import ConfigError, RunDirError, SecretError
from rce.config.secret import load_secret
from rce.config.settings import load_settings
from rce.guard.files import raise_file_limit
from rce.protocol.quantities import read_memory
from rce_master.exceptions import MasterError
from rce_master.master import Master, RunningMaster
from rce_master.settings import MasterSettings
from rce_master.state.settings import StateSettings
from rce_master.store import SqliteStore

if TYPE_CHECKING:
    from rce.config.secret import Secret

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def command(
    config: Annotated[Path | None, typer.Option(help="Engine settings (YAML); options win.")] = None,
    bind: Annotated[str | None, typer.Option(help="Address to listen on [all].")] = None,
    http_port: Annotated[int | None, typer.Option(help="For clients, REST, metrics [9000].")] = None,
    control_port: Annotated[int | None, typer.Option(help="For task sets [8080].")] = None,
    state_dir: Annotated[Path | None, typer.Option(help="Where users and desired state are kept.")] = None,
    secret_file: Annotated[Path | None, typer.Option(help="File with the secret of the task sets.")] = None,
    dev: Annotated[bool, typer.Option("--dev", help="Loopback only, user testUser/testUser.")] = False,
    tls_cert: Annotated[Path | None, typer.Option(help="Serve HTTPS with this certificate.")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="The certificate's key.")] = None,
    allow_origin: Annotated[
        list[str] | None, typer.Option(help="Let pages of this origin use the server; may be repeated.")
    ] = None,
    trusted_proxy: Annotated[
        list[str] | None,
        typer.Option(help="Believe this proxy's (or network's) X-Forwarded-For; may be repeated."),
    ] = None,
    robot_grace: Annotated[
        float | None, typer.Option(help="Seconds that a robot's interfaces outlive its connection [60].")
    ] = None,
    container_grace: Annotated[
        float | None, typer.Option(help="Seconds until containers of a machine that is away move [30].")
    ] = None,
    token_lifetime: Annotated[
        float | None, typer.Option(help="Seconds that an API token is valid [2592000].")
    ] = None,
    max_slots: Annotated[
        int | None, typer.Option(help="Slots that one user's containers may take; 0: no limit [0].", min=0)
    ] = None,
    max_cpu: Annotated[
        float | None, typer.Option(help="Cores that one user's containers may ask for; 0: no limit [0].")
    ] = None,
    max_memory: Annotated[
        str | None, typer.Option(help="Memory that one user's containers may ask for, such as 8G [0].")
    ] = None,
    log_level: Annotated[str, typer.Option(help="debug, info, warning or error.")] = "info",
) -> None:
    """Run the Master Task Set: HTTP for clients on 9000, control of task sets on 8080."""
    logging.basicConfig(level=log_level.upper(), format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    for name in ("websockets", "aiosqlite"):  # what these tell in detail holds the secret, tokens and hashes
        logging.getLogger(name).setLevel(logging.WARNING)
    given = {
        "bind": bind,
        "http_port": http_port,
        "control_port": control_port,
        "robot_grace": robot_grace,
        "container_grace": container_grace,
        "token_lifetime": token_lifetime,
        "max_slots": max_slots,
        "max_cpu": max_cpu,
        "max_memory": None if max_memory is None else _memory(max_memory),
    }
    raise_file_limit()
    faults: tuple[BaseException, ...] = ()
    try:
        engine = load_settings(config)
        engine = engine.for_development() if dev else engine
        chosen = engine.master.model_copy(update={k: v for k, v in given.items() if v is not None})
        settings = MasterSettings(
            bind=chosen.bind,
            http_port=chosen.http_port,
            control_port=chosen.control_port,
            state_dir=state_dir or engine.state_dir / "master",
            dev=engine.dev,
            tls_cert=tls_cert,
            tls_key=tls_key,
            allowed_origins=tuple(allow_origin or ()),
            trusted_proxies=tuple(trusted_proxy or chosen.trusted_proxies),
            token_lifetime=chosen.token_lifetime,
            state=StateSettings(
                robot_grace=chosen.robot_grace,
                container_grace=chosen.container_grace,
                max_slots=chosen.max_slots,
                max_cpu=chosen.max_cpu,
                max_memory=chosen.max_memory,
            ),
        )
        secret = load_secret(secret_file or engine.secret_file, dev=engine.dev)
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(_run(settings, secret))
    except* (MasterError, ConfigError, SecretError, RunDirError) as group:
        faults = group.exceptions
    for fault in faults:
        typer.echo(f"rce-master: {fault}", err=True)
    if faults:
        raise typer.Exit(1)


def _memory(text: str) -> int:
    try:
        return read_memory(text)
    except ValueError as error:
        raise typer.BadParameter(f"--max-memory {error}") from None


async def _run(settings: MasterSettings, secret: Secret) -> None:
    """Run until SIGINT or SIGTERM."""
    task = asyncio.current_task()
    assert task is not None
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    store = await SqliteStore.open(settings.state_dir)
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await Master(settings, secret, store).run(_announce)
    finally:
        await store.close()


def _announce(master: RunningMaster) -> None:
    typer.echo(f"rce-master ready: {master.url}")


def main() -> None:
    """Run the program."""
    app(prog_name="rce-master")


if __name__ == "__main__":
    main()
