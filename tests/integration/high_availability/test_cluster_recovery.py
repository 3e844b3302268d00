"""When ``rce cluster recover`` takes another member of etcd for a lost one."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
from support.go_between import LOOPBACK
from support.ports import free_ports

from rce.tls.folder import CertificateFolder
from rce.tls.identity import TlsFiles, TlsIdentity
from rce_master.cluster.files import Machine
from rce_master.cluster.members import ClusterError, Member
from rce_master.cluster.recovery import recover

NO_DATA = "is missing: restore a backup"
"""What is said once all others count as lost."""


async def refusal(folder: Path, port: int, *, tls: bool = False, force: bool = False) -> str:
    """Return what a machine without data says; the other one has a port of this machine."""
    client, peer = free_ports(2)
    machine = Machine("m1", LOOPBACK, client, peer, folder, tls=tls)
    other = Member(2, "m2", f"{LOOPBACK}:{peer + 1}", f"{LOOPBACK}:{port}")
    contexts = None
    if tls:
        made = CertificateFolder(machine.certificates)
        made.make_authority()
        made.issue("engine", hosts=[LOOPBACK])
        files = TlsFiles(made.certificate("engine"), made.key("engine"), made.authority)
        contexts = TlsIdentity(files).client
    with pytest.raises(ClusterError) as caught:
        await recover(machine, [other], contexts, force=force)
    return str(caught.value)


@pytest.mark.parametrize("tls", [False, True])
async def test_silent_member_is_not_lost(tmp_path: Path, tls: bool) -> None:
    """Its program is stopped: the system accepts connections for it, and it may go on at any time."""
    with socket.create_server((LOOPBACK, 0)) as silent:
        told = await refusal(tmp_path, silent.getsockname()[1], tls=tls)
    assert f"etcd on m2 ({LOOPBACK}:" in told
    assert "may work: its port takes connections (etcd does not answer: " in told
    assert "--force" in told


async def test_silent_member_is_given_up_by_force(tmp_path: Path) -> None:
    with socket.create_server((LOOPBACK, 0)) as silent:
        assert NO_DATA in await refusal(tmp_path, silent.getsockname()[1], force=True)


async def test_member_without_a_program_is_lost(tmp_path: Path) -> None:
    assert NO_DATA in await refusal(tmp_path, free_ports(1)[0])
