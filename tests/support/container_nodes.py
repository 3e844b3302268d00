"""Programs of nodes that tests run in containers."""

from __future__ import annotations

_STATEFUL = """import asyncio
from rce.ros.node import Node, run

async def main():
    state = {state}
    async def save(_):
        {wait}
        return {{"data": state}}
    def restore(request):
        nonlocal state
        state = bytes(request.data)
        return {{}}
    async with Node("{name}") as node:
        await node.advertise_service("save_count", "rce_msgs/SaveState", save)
        await node.advertise_service("restore_count", "rce_msgs/RestoreState", restore)
        await node.spin()

run(main())
"""
"""A node whose services are in its own namespace, as several of them are in one container."""

NODES = {
    "deaf.py": _STATEFUL.format(name="deaf", state="b''", wait="await asyncio.Event().wait()"),
    "huge.py": _STATEFUL.format(name="huge", state="bytes((16 << 20) + 1)", wait="pass"),
    "grow.py": _STATEFUL.format(name="grow", state="b''", wait="nonlocal state\n        state += b'x'"),
    "echo_state.py": _STATEFUL.format(name="large", state="b''", wait="pass"),
    "fixed_state.py": _STATEFUL.format(name="fixed", state="__import__('os').urandom(8)", wait="pass"),
    "talk.py": "import os, sys, time\nprint('hello', *sys.argv[1:], flush=True)\ntime.sleep(600)\n",
    "keep.py": (
        "import os, pathlib, time\n"
        "folder = pathlib.Path(os.environ['RCE_VOLUME_JOURNAL'])\n"
        "with (folder / 'log').open('a') as file:\n"
        "    file.write('run\\n')\n"
        "print(folder, len((folder / 'log').read_text().split()), 'runs', flush=True)\n"
        "time.sleep(600)\n"
    ),
    "fill.py": (
        "import os, pathlib, time\n"
        "folder = pathlib.Path(os.environ['RCE_VOLUME_JOURNAL'])\n"
        "try:\n"
        "    with (folder / 'big').open('wb', buffering=0) as file:\n"
        "        for _ in range(64):\n"
        "            file.write(bytes(1 << 20))\n"
        "except OSError as error:\n"
        "    print('stopped', error.errno, flush=True)\n"
        "print('wrote', (folder / 'big').stat().st_size, flush=True)\n"
        "time.sleep(600)\n"
    ),
    "fail.py": "import sys\nprint('it is broken', flush=True)\nsys.exit(3)\n",
    "end.py": "print('done')\n",
    "stubborn.py": (
        "import signal, time\n"
        "for number in (signal.SIGINT, signal.SIGTERM):\n"
        "    signal.signal(number, lambda *_: print('no', number, flush=True))\n"
        "print('ready', flush=True)\n"
        "while True:\n    time.sleep(1)\n"
    ),
    "daemon.py": (
        "import os, time\n"
        "if os.fork() == 0:\n"
        "    os.setsid()\n"
        "    if os.fork() == 0:\n"
        "        print('daemon', flush=True)\n"
        "        time.sleep(600)\n"
        "    os._exit(0)\n"
        "os.wait()\n"
        "time.sleep(600)\n"
    ),
    "flood.py": "import sys\nwhile True:\n    sys.stdout.write('x' * 99 + chr(10))\n",
    "look.py": (
        "import json, os, socket\n"
        "def can(path):\n"
        "    try:\n        open(path, 'w').close()\n"
        "    except OSError:\n        return False\n"
        "    os.unlink(path)\n    return True\n"
        "def net(address):\n"
        "    try:\n        socket.create_connection(address, 2).close()\n"
        "    except OSError:\n        return False\n"
        "    return True\n"
        "def spy():\n"
        "    for act in (lambda: open('/proc/1/mem'), lambda: os.readlink('/proc/1/fd/0')):\n"
        "        try:\n            act()\n"
        "        except OSError:\n            continue\n"
        "        return True\n"
        "    return False\n"
        "import sys\n"
        "host, port, secret = sys.argv[1], int(sys.argv[2]), sys.argv[3]\n"
        "print(json.dumps({\n"
        "    'env': dict(os.environ), 'root': sorted(os.listdir('/')), 'uid': os.getuid(),\n"
        "    'pids': sorted(int(p) for p in os.listdir('/proc') if p.isdigit()),\n"
        "    'host': socket.gethostname(), 'home': can('home.txt'), 'tmp': can('/tmp/x'),\n"
        "    'usr': can('/usr/x'), 'slash': can('/x'), 'package': can(__file__ + 'x'),\n"
        "    'loopback': net((host, port)), 'secret': os.path.exists(secret),\n"
        "    'environment': spy(),\n"
        "    'caps': next(l for l in open('/proc/self/status') if l.startswith('CapEff')).split()[1],\n"
        "    'nnp': next(l for l in open('/proc/self/status') if l.startswith('NoNewPrivs')).split()[1],\n"
        "}), flush=True)\n"
    ),
}
