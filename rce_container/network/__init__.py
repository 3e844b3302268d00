"""The networks of containers: private switches that join the containers of one user's group on this machine.

A group's switch is a bridge in a network namespace of its own. That namespace has no name: it exists as long
as a descriptor of it, and the shim of each of the group's containers holds one. So the kernel removes the
switch with the group's last container, in whatever order processes are killed, and no cleanup is needed.
"""

from rce_container.network.networks import Membership, Networks

__all__ = ["Membership", "Networks"]
