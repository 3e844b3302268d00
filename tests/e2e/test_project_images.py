"""The project's Containerfile, built on Debian's packages of Python, and both of its images run."""

from __future__ import annotations

import asyncio
import os
import secrets
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.debian_root import make_debian_root
from support.engine import Program
from support.ports import free_ports
from support.rootfs import image_of

ROOT = Path(__file__).parents[2]
ASK = ROOT / "tests" / "support" / "ask.py"
BIN = Path(sys.executable).parent
TIMEOUT_S = 300.0

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.needs("root", "podman", "venv packages"),
    pytest.mark.timeout(2400),
]

# crun refuses machines that have controllers in cgroups of both versions: the newer one is hidden from it.
_APART = ("unshare", "--mount", "sh", "-c")
_HIDE = '[ ! -d /sys/fs/cgroup/unified ] || mount -t tmpfs tmpfs /sys/fs/cgroup/unified; exec "$@"'
_RUN = ("podman", "run", "--rm", "--pull=never", "--network=host", "--cgroups=disabled")
_LIMITS = (
    "--ulimit=nofile=1024:1024",
    "--ulimit=nproc=4096:4096",
)  # podman's own may be above what is allowed


def podman(*arguments: str) -> str:
    done = subprocess.run(["podman", *arguments], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


def pip_settings(folder: Path) -> list[str]:
    """Options of ``podman build`` that let pip look in the image where it looks on this machine."""
    pythons = [python for python in (sys.executable, f"{sys.base_prefix}/bin/python3") if _has_pip(python)]
    listing = subprocess.run(
        [pythons[0], "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    ).stdout
    values: dict[str, str] = {}
    for line in listing.splitlines():
        key, _, value = line.partition("=")
        scope, _, name = key.rpartition(".")
        if scope in ("global", "user", "site", "install", ":env:"):
            values[name] = value.strip("'\"")
    config = folder / "pip.conf"
    lines = [f"{name} = {value}" for name, value in values.items()]
    # Compiling all modules of all packages takes longer than compiling those that the test uses.
    config.write_text("\n".join(["[global]", *lines, "[install]", "compile = false", ""]))
    paths = set()
    for word in " ".join(values.values()).split():
        parts = urlsplit(word)
        if parts.scheme == "file":  # an index: its files stand beside its pages
            paths.add(str(Path(parts.path).parent))
        elif not parts.scheme and "/" in word:
            paths.add(word)
    mounted = [f"--volume={path}:{path}:ro" for path in map(_existing, sorted(paths)) if path]
    return [f"--secret=id=pip.conf,src={config}", "--network=host", "--isolation=chroot", *mounted]


def _has_pip(python: str) -> bool:
    return subprocess.run([python, "-c", "import pip"], check=False, capture_output=True).returncode == 0


def _existing(path: str) -> str:
    return path if Path(path).is_absolute() and Path(path).exists() else ""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An image of Debian with Python; ``RCE_TEST_BASE`` names one that is in podman's store already."""
    if given := os.environ.get("RCE_TEST_BASE"):
        yield given
        return
    rootfs = tmp_path_factory.mktemp("rootfs") / "root"
    make_debian_root(rootfs, ("python3", "python3-venv", "ca-certificates"))
    with image_of(rootfs) as name:
        yield name


@pytest.fixture(scope="module")
def images(base: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The images by target; that of the wheel has a name too, so that it is removed with the others."""
    options = pip_settings(tmp_path_factory.mktemp("pip"))
    tag = f"{os.getpid()}-{secrets.token_hex(4)}"
    made = {target: f"localhost/rce-{target}-test:{tag}" for target in ("wheel", "robot", "engine")}
    try:
        for target, name in made.items():
            podman("build", "--build-arg", f"BASE={base}", *options, "--target", target, "--tag", name, ".")
        yield made
    finally:
        subprocess.run(["podman", "rmi", "--force", *made.values()], capture_output=True, check=False)


def run(*options: str) -> list[str]:
    return [*_APART, _HIDE, "sh", *_RUN, *_LIMITS, *options]


@pytest.fixture
def volume() -> Iterator[str]:
    """The name of a volume, which is removed at the end."""
    name = f"rce-state-{os.getpid()}-{secrets.token_hex(4)}"
    yield name
    podman("volume", "rm", "--force", name)


def run_once(*argv: str, text: str = "") -> None:
    done = subprocess.run(argv, input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


async def test_robot_image_works_with_engine_image(
    images: dict[str, str], volume: str, tmp_path: Path
) -> None:
    """A message goes from a ROS graph through the robot's image and the engine's, and back.

    The engine is set up as its page says: with a secret's file, a first user, and a volume that is backed up.
    """
    names = ("--http-port", "--control-port", "--ws-port", "--robot-link-port", "--container-link-port")
    core_port, *ports = free_ports(1 + len(names))
    options = [word for name, port in zip(names, ports, strict=True) for word in (name, str(port))]
    state = ("--state-dir", "/var/lib/rce")
    up = ["rce", "up", "--bind", "127.0.0.1", *state, "--runtime", "process", *options]
    secret, kept = tmp_path / "secret", f"--volume={volume}:/var/lib/rce"
    run_once(str(BIN / "rce"), "secret", "new", str(secret))
    add_user = ("rce", "user", "add", "testUser", "--admin", "--password-stdin", *state)
    run_once(*run("--interactive", kept, images["engine"], *add_user), text="testUser")
    shown = (f"--volume={secret}:/run/secrets/rce:ro", "--env", "RCE_SECRET_FILE=/run/secrets/rce")
    config = tmp_path / "robot.config"
    text = (ROOT / "configs/test.config").read_text()
    config.write_text(text.replace("http://localhost:9000/", f"http://127.0.0.1:{ports[0]}/"))
    config.chmod(0o644)
    tmp_path.chmod(0o755)
    uri = f"http://127.0.0.1:{core_port}/"
    env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    env |= {"ROS_MASTER_URI": uri, "HOME": str(tmp_path)}
    core = Program("core", [str(BIN / "rce"), "core", "--port", str(core_port)], env, tmp_path)
    started = run("--name", volume, kept, *shown, images["engine"], *up)
    engine = Program("engine", started, dict(os.environ), tmp_path)
    mount = f"--volume={config}:/robot.config:ro"
    robot = Program(
        "robot", run("--env", f"ROS_MASTER_URI={uri}", mount, images["robot"]), dict(os.environ), tmp_path
    )
    try:
        await core.start(ready="ready:", timeout=TIMEOUT_S)
        await engine.start(ready="RCE ready:", timeout=TIMEOUT_S)
        await robot.start(ready="rce-ros ready:", timeout=TIMEOUT_S)
        asking = await asyncio.create_subprocess_exec(
            *("timeout", "180", sys.executable, "-P", str(ASK), "/stringEchoReq", "/stringEchoResp"),
            env=env,
            stdout=asyncio.subprocess.PIPE,
        )
        output, _ = await asking.communicate()
        assert output.decode().strip() == "answer: hello", robot.output()
        backup = ("rce", "backup", "/var/lib/rce/backup.tar", *state)
        run_once(*_APART, _HIDE, "sh", "podman", "exec", volume, *backup)
        assert await robot.stop() == 0, robot.output()
        assert await engine.stop() == 0, engine.output()
    finally:
        for program in (robot, engine, core):
            if program.running:
                await program.stop()


def test_robot_image_has_the_base_only(images: dict[str, str]) -> None:
    listing = subprocess.run(
        run("--entrypoint", "pip", images["robot"], "list", "--format", "freeze"),
        capture_output=True,
        text=True,
        check=False,
    )
    assert listing.returncode == 0, listing.stderr
    assert "websockets" in listing.stdout
    assert "aiohttp" not in listing.stdout
