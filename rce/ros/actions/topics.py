"""Names and types of an action's topics, and the parameters of its server."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rce.ros.node import Node

_log = logging.getLogger(__name__)

GOAL_ID = "actionlib_msgs/GoalID"
STATUS = "actionlib_msgs/GoalStatusArray"


class ActionTypes(NamedTuple):
    """The types of the topics that differ from action to action."""

    action_goal: str
    action_feedback: str
    action_result: str

    @classmethod
    def named(cls, action_type: str) -> ActionTypes:
        """Return the types of the action ``package/Name`` or ``package/NameAction``."""
        base = action_type.removesuffix("Action")
        return cls(f"{base}ActionGoal", f"{base}ActionFeedback", f"{base}ActionResult")


async def number(node: Node, parameter: str, default: float) -> float:
    """Return a parameter that holds a number; anything else in it is ignored with a warning."""
    value = await node.get_param(parameter, default)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    _log.warning("parameter %s holds %r, not a number; %s is used", parameter, value, default)
    return default
