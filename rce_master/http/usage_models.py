"""The resource usage in answers of the REST API. Bytes, bytes per second, and processor cores."""

from __future__ import annotations

from rce_master.http.model import Model, Page


class AdviceOut(Model):
    """A possible improvement, and the command for it."""

    about: str
    """``too small``, ``too large`` or ``too full``."""
    text: str
    command: str


class NodeUsageOut(Model):
    """The resource usage of a node, with all processes that it started."""

    tag: str
    state: str
    cpu: float
    """Cores in use now."""
    cpu_s: float
    memory: int
    processes: int
    restarts: int


class ContainerUsageOut(Model):
    """The resource usage of a container."""

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
    """Share of the time in which its CPU limit stops it now."""
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
    """Automatic restarts of its nodes."""
    nodes: list[NodeUsageOut]
    advice: list[AdviceOut]


class MachineUsageOut(Model):
    """A container machine: its resources, how much of them is reserved, and how much its containers use."""

    process: str
    machine: str
    connected: bool
    draining: bool
    containers: int
    slots: int
    """0 if slots are not counted."""
    promised_slots: int
    cores: int
    promised_cores: float
    cpu: float
    """Cores that its containers use now."""
    memory: int
    promised_memory: int
    memory_used: int
    """Bytes that its containers use."""
    advice: list[AdviceOut]


class UsageOut(Page):
    """The present resource usage; ``next`` is about the containers."""

    time: float
    """Seconds since 1970."""
    containers: list[ContainerUsageOut]
    machines: list[MachineUsageOut]
    """For administrators, and in the first page only; else empty."""
