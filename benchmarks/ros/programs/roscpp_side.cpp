// The roscpp side of the measurements; of the words of ours.py: echo, ping, idle.
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <std_msgs/String.h>

#include <chrono>
#include <iostream>
#include <regex>
#include <string>
#include <vector>

static ros::Publisher out;
static bool answered = false;

static void echo(const std_msgs::String::ConstPtr& message) { out.publish(message); }
static void answer(const std_msgs::String::ConstPtr&) { answered = true; }

static void ping(const std::string& sizes) {
  while (out.getNumSubscribers() < 1) ros::WallDuration(0.05).sleep();
  ros::WallDuration(1).sleep();
  const std::regex pair("\\[(\\d+), (\\d+)\\]");
  std::string separator = "{";
  for (std::sregex_iterator one(sizes.begin(), sizes.end(), pair), end; one != end; ++one) {
    std_msgs::String message;
    message.data = std::string(std::stoul((*one)[1]), 'x');
    const int count = std::stoi((*one)[2]);
    std::cout << separator << "\"" << (*one)[1] << "\": [";
    separator = ", ";
    for (int i = 0; i < count + 3; ++i) {
      answered = false;
      const auto begin = std::chrono::steady_clock::now();
      out.publish(message);
      while (!answered) ros::getGlobalCallbackQueue()->callOne(ros::WallDuration(1));
      const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begin;
      if (i >= 3) std::cout << (i > 3 ? ", " : "") << took.count();
    }
    std::cout << "]";
  }
  std::cout << "}" << std::endl;
}

int main(int argc, char** argv) {
  const std::string word = argv[1];
  ros::init(argc, argv, "roscpp_" + word);
  ros::NodeHandle node;
  const ros::TransportHints hints = ros::TransportHints().tcpNoDelay();
  if (word == "ping") {
    out = node.advertise<std_msgs::String>("ping", 10);
    ros::Subscriber in = node.subscribe("pong", 10, answer, hints);
    ping(argv[2]);
    return 0;
  }
  out = node.advertise<std_msgs::String>(word == "echo" ? "pong" : "idle_out", 10);
  ros::Subscriber in = node.subscribe(word == "echo" ? "ping" : "idle_in", 10, echo, hints);
  std::cout << "ready" << std::endl;
  ros::spin();
  return 0;
}
