#!/usr/bin/env python3
"""A rospy node that echoes a topic, provides and calls services, and reads and sets parameters."""

import rospy
from rospy.msg import AnyMsg
from std_msgs.msg import String
from std_srvs.srv import SetBool, SetBoolResponse, Trigger, TriggerResponse

rospy.init_node("rospy_peer")
echo = rospy.Publisher("peer_out", String, queue_size=100)
latched = rospy.Publisher("peer_latched", String, queue_size=1, latch=True)
latched.publish("kept " + rospy.get_param("~word", "nothing"))
kinds = rospy.Publisher("peer_kinds", String, queue_size=10, latch=True)
rospy.Subscriber("peer_in", String, lambda message: echo.publish(message.data), buff_size=2**24)
rospy.Subscriber("peer_any", AnyMsg, lambda message: kinds.publish(message._connection_header["type"]))


def set_bool(request: SetBool) -> SetBoolResponse:
    if not request.data:
        raise rospy.ServiceException("as asked")
    rospy.set_param("~set", True)
    return SetBoolResponse(True, "done")


def ask(_request: Trigger) -> TriggerResponse:
    answer = rospy.ServiceProxy("ours_trigger", Trigger, persistent=True)()
    return TriggerResponse(answer.success, "rospy got: " + answer.message)


rospy.Service("peer_set", SetBool, set_bool)
rospy.Service("peer_ask", Trigger, ask)
rospy.loginfo("ready")
rospy.spin()
