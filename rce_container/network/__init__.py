"""The networks of containers: private switches that join the containers of one user's group on this machine.

A group's switch is a bridge in a network namespace of its own. That namespace has no name: it lives as long
as a descriptor of it, and the shims of the group's containers hold one each. So the kernel removes the switch
with the group's last container, whoever is killed in whatever order, and nothing has to be swept.
"""

from rce_container.network.networks import Membership, Networks

__all__ = ["Membership", "Networks"]
