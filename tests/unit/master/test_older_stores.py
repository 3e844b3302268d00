"""Stores that an earlier release wrote are read as they are, and what they lack has its default."""

from __future__ import annotations

from rce.model.specs import Network, RestartPolicy
from rce_master.state.core import State

# As the first release wrote them.
ROWS = {
    "users": {"anna": b'{"name":"anna","role":"user","password":"x","created":0.0}'},
    "tokens": {"d": b'{"digest":"d","user":"anna","label":"","created":0.0,"expires":9000000000.0}'},
    "endpoints": {
        "anna/rob": b'{"type":"Robot","id":"anna/rob","revision":7,"task_set":"r1","interfaces":{"out":'
        b'{"tag":"out","type":"SubscriberConverter","cls":"std_msgs/String"}},"size":66}',
        "anna/c": b'{"type":"Container","id":"anna/c","revision":8,"task_set":"c1","interfaces":{"in":'
        b'{"tag":"in","type":"PublisherInterface","cls":"std_msgs/String","addr":"/in"}},"size":207,"resources":'
        b'{"group":"g","group_ip":"10.0.0.2","size":2,"cpu":0.5,"memory":1000,"bandwidth":5},"nodes":{"n":{"tag":"n","pkg":'
        b'"Test","exe":"run.py"}},"parameters":{"p":1.5},"address":{}}',
    },
    "links": {
        "link1": b'{"id":"link1","a":"anna/c","b":"anna/rob","token":"secret","connections":{"1":{"id":1,'
        b'"interface_a":"in","interface_b":"out"}}}'
    },
    "task_sets": {
        "r1": b'{"process":"r1","kind":"robot","machine":{"name":"m"},"url":"ws://r1/","address":{"machine":"m",'
        b'"host":"h","port":1}}',
        "c1": b'{"process":"c1","kind":"container","machine":{"name":"m"},"url":"","address":{}}',
    },
    "counters": {
        "revision": b'{"name":"revision","value":8}',
        "link": b'{"name":"link","value":1}',
        "connection": b'{"name":"connection","value":1}',
    },
}


def test_what_the_first_release_wrote_is_read() -> None:
    state = State.load(ROWS, 0.0)
    state.validate()
    spec = state.spec("anna/c")
    (node,) = spec.nodes
    assert (node.restart, node.after, node.heartbeat) == (RestartPolicy.NEVER, (), "")
    assert (spec.resources.network, spec.resources.image, spec.resources.cpu) == (Network.NONE, "", 0.5)
    assert [one.id for one in spec.connections] == [1]
    container = state.tables.container("anna/c")
    assert container is not None
    assert (container.made, container.number, container.born) == (None, 0, 0)
