"""The robot's end of connections: four roles, each with messages as JSON objects or serialized.

Roles are named from the engine's side (:class:`rce.model.names.Role`):

=================  ======================================  ==================================
role               from the robot                          to the robot
=================  ======================================  ==================================
Subscriber         messages, sent on to every peer         -
Publisher          -                                       messages of peers
ServiceProvider    requests, each with its own ``msgID``   answers with the request's ``msgID``
ServiceClient      answers                                 requests of peers
=================  ======================================  ==================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING, assert_never

from rce.model import Role
from rce_robot.services import AnsweredByRobot, AskedByRobot
from rce_robot.topics import FromRobot, ToRobot

if TYPE_CHECKING:
    from rce.link import Port
    from rce_robot.forms import Form
    from rce_robot.interface import RobotInterface, RobotSide


def make_interface(
    role: Role, port: Port, robot: RobotSide, form_in: Form, form_out: Form, *, call_timeout: float
) -> RobotInterface:
    """Make the robot's end of an interface of the given role."""
    match role:
        case Role.SUBSCRIBER:
            return FromRobot(port, robot, form_in, form_out)
        case Role.PUBLISHER:
            return ToRobot(port, robot, form_in, form_out)
        case Role.SERVICE_PROVIDER:
            return AskedByRobot(port, robot, form_in, form_out)
        case Role.SERVICE_CLIENT:
            return AnsweredByRobot(port, robot, form_in, form_out, call_timeout=call_timeout)
        case _:
            assert_never(role)
