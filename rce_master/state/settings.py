"""Grace times and limits of the state."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StateSettings:
    """Grace times in seconds, and how many of each a user may have."""

    robot_grace: float = 60.0
    """How long a robot's interfaces and connections are kept after its connection dropped."""
    container_grace: float = 30.0
    """How long a container task set may be away until its containers are placed elsewhere."""
    placement_timeout: float = 10.0
    """How long a container waits for a machine until its user is told."""
    login_timeout: float = 15.0
    """How long a robot that was let in may take until its task set reports it; then it counts as away."""
    move_timeout: float = 60.0
    """How long a container's copy at another machine may take to come up, when its machine is drained."""
    link_timeout: float = 10.0
    """How long the links of a copy may take to be established beside those of the container."""
    departure_timeout: float = 15.0
    """How long a container that was handed over may take for its last answers."""
    volume_move_timeout: float = 1800.0
    """How long each phase of a move with volumes may take: to end, to save, to restore."""
    move_rest: float = 30.0
    """How long a container stays after a move of it failed, until the next is tried."""
    max_work: int = 10_000
    """How much work that can be continued later a command does, in units of about a microsecond: placing of
    containers, giving them up with their machine, removing robots that stayed away, ending the sessions of
    robots. Other commands, and all input and output of the master, wait while a command is applied."""
    max_robots: int = 2000
    """Of one user."""
    max_containers: int = 1000
    """Of one user; 0 for no limit. This and the next four do not apply to administrators. They, and those
    of packages, can be set for single users."""
    user_share: float = 0.0
    """Share of what all machines have (slots, cores, memory) that one user's containers may take together;
    0 for no limit."""
    max_slots: int = 0
    """All containers of one user together, as ``size`` counts them; 0 for no limit."""
    max_cpu: float = 0.0
    """Cores that one user's containers may ask for together; 0 for no limit."""
    max_memory: int = 0
    """Bytes that one user's containers may ask for together; 0 for no limit."""
    max_nodes: int = 500
    """In one container."""
    max_parameters: int = 5000
    """In one container."""
    max_interfaces: int = 12_000
    """Of one endpoint: a container that serves a fleet has six or so for each of ``max_robots`` robots. Each
    has a record of its own, and a change costs what it changes: the limit bounds memory only."""
    max_connections: int = 24_000
    """Of one endpoint."""
    max_link_connections: int = 4096
    """Of two endpoints with each other, at most as many as their link takes
    (:attr:`rce.link.settings.LinkLimits.max_channels`): it ends whenever there is one more."""
    max_user_interfaces: int = 50_000
    """Of all endpoints of one user. The master keeps about 2 kB for each; what they take where they are in
    use counts there, for the container or for the user's robots."""
    max_user_connections: int = 50_000
    """Of all links of one user."""
    max_tokens: int = 100
    """Logins of one user; the one that was not used for longest makes room for a new one."""
    max_package_keys: int = 20
    """Of one user."""
    max_packages: int = 500
    """Versions of packages of one user."""
    max_package_bytes: int = 2 * 2**30
    """All archives of one user's packages together."""
    max_package_size: int = 8 * 2**30
    """All files of one user's packages together, on the machines where they are unpacked; and all volumes."""
    max_endpoint_bytes: int = 2 * 2**20
    """What the nodes, parameters and interfaces of one endpoint take when they are written down. All are sent
    when a task set or a container starts again; a change of a node or a parameter is stored and sent with all
    other nodes and parameters."""
    max_user_bytes: int = 32 * 2**20
    """The same of all of a user's endpoints together."""
