"""Actions: long tasks that one node requests from another, with feedback, cancellation and a result.

On the wire it is ROS's actionlib: five topics below the action's name.
"""

from rce.ros.actions.client import ActionClient
from rce.ros.actions.client_goal import ClientGoal
from rce.ros.actions.exceptions import ActionError, GoalFailedError, IllegalTransitionError, UnknownGoalError
from rce.ros.actions.goal_id import GoalId
from rce.ros.actions.server import ActionServer, SimpleActionServer
from rce.ros.actions.server_goal import ServerGoal
from rce.ros.actions.states import CommState, GoalEvent, GoalState

__all__ = [
    "ActionClient",
    "ActionError",
    "ActionServer",
    "ClientGoal",
    "CommState",
    "GoalEvent",
    "GoalFailedError",
    "GoalId",
    "GoalState",
    "IllegalTransitionError",
    "ServerGoal",
    "SimpleActionServer",
    "UnknownGoalError",
]
