// A roscpp node that does what rospy_peer.py does; with ~udp it asks for UDPROS first.
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <std_srvs/SetBool.h>
#include <std_srvs/Trigger.h>

static ros::Publisher echo;

static void heard(const std_msgs::String::ConstPtr& message) { echo.publish(message); }

static bool setBool(std_srvs::SetBool::Request& request, std_srvs::SetBool::Response& response) {
  if (!request.data) return false;
  ros::param::set("~set", true);
  response.success = true;
  response.message = "done";
  return true;
}

static bool ask(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response) {
  std_srvs::Trigger call;
  response.success = ros::service::call("ours_trigger", call) && call.response.success;
  response.message = "roscpp got: " + call.response.message;
  return true;
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "roscpp_peer");
  ros::NodeHandle node;
  ros::NodeHandle own("~");
  echo = node.advertise<std_msgs::String>("peer_out", 100);
  ros::Publisher latched = node.advertise<std_msgs::String>("peer_latched", 1, true);
  std_msgs::String word;
  word.data = "kept " + own.param<std::string>("word", "nothing");
  latched.publish(word);
  ros::TransportHints hints;
  if (own.param("udp", false)) hints.unreliable().reliable();
  ros::Subscriber in = node.subscribe("peer_in", 100, heard, hints);
  ros::ServiceServer set = node.advertiseService("peer_set", setBool);
  ros::ServiceServer asking = node.advertiseService("peer_ask", ask);
  ROS_INFO("ready");
  ros::spin();
  return 0;
}
