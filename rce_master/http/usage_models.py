"""What the REST API tells of consumption. Bytes, bytes per second, and processor cores."""

from __future__ import annotations

from rce_master.http.model import Model


class AdviceOut(Model):
    """What could be better, and the command that mends it."""

    about: str
    """``too small``, ``too large`` or ``too full``."""
    text: str
    command: str


class NodeUsageOut(Model):
    """What a node consumes, with all processes that it started."""

    tag: str
    state: str
    cpu: float
    """Cores in use now."""
    cpu_s: float
    memory: int
    processes: int
    restarts: int


class ContainerUsageOut(Model):
    """What a container consumes."""

    id: str
    user: str
    tag: str
    state: str
    machine: str
    cpu: float
    """Cores in use now."""
    cpu_limit: float
    """0: no limit."""
    throttled: float
    """Share of the time in which it is held back by its CPU limit now."""
    cpu_s: float
    throttled_s: float
    memory: int
    memory_peak: int
    memory_limit: int
    """0: no limit."""
    oom_kills: int
    io_read: int
    io_written: int
    io_read_rate: float
    io_written_rate: float
    link_in: int
    link_out: int
    link_in_rate: float
    link_out_rate: float
    processes: int
    restarts: int
    """Of its nodes, by themselves."""
    nodes: list[NodeUsageOut]
    advice: list[AdviceOut]


class MachineUsageOut(Model):
    """What a container machine has, what is promised of it, and what its containers use."""

    process: str
    machine: str
    connected: bool
    draining: bool
    containers: int
    slots: int
    """0 if it is not counted."""
    promised_slots: int
    cores: int
    promised_cores: float
    cpu: float
    """Cores in use by its containers now."""
    memory: int
    promised_memory: int
    memory_used: int
    """By its containers."""
    advice: list[AdviceOut]


class UsageOut(Model):
    """What is consumed now."""

    time: float
    """Seconds since 1970."""
    containers: list[ContainerUsageOut]
    machines: list[MachineUsageOut]
    """For administrators; else empty."""
