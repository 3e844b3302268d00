// What all programs have in common: their arguments, their node, and a loop until they are told to stop.

#pragma once

#include <csignal>
#include <ctime>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include <ros/ros.h>

// Messages that wait for a slow subscriber before the oldest is dropped.
constexpr std::uint32_t QUEUE = 10;

// A command line without the names of program and node.
struct Arguments {
  std::vector<std::string> words;
  std::map<std::string, std::string> options;

  static Arguments of(int argc, char** argv) {
    Arguments found;
    for (int at = 2; at < argc; ++at) {
      const std::string word = argv[at];
      if (word.rfind("--", 0) != 0) {
        found.words.push_back(word);
      } else if (at + 1 < argc) {
        found.options[word.substr(2)] = argv[++at];
      } else {
        throw std::invalid_argument(word + " needs a value");
      }
    }
    return found;
  }

  const std::string& option(const std::string& name) const {
    const auto found = options.find(name);
    if (found == options.end()) {
      throw std::invalid_argument("--" + name + " is missing");
    }
    return found->second;
  }

  const std::string& word(std::size_t number) const {
    if (number >= words.size()) {
      throw std::invalid_argument("an argument is missing");
    }
    return words[number];
  }
};

// Takes messages in a thread of their own; calls step, which returns the seconds until its next call.
template <class Step>
void run(Step step) {
  ros::AsyncSpinner spinner(1);
  spinner.start();
  while (ros::ok()) {
    const double seconds = step();
    ros::WallDuration(seconds).sleep();
  }
  spinner.stop();
}

inline void start_node(int argc, char** argv) {
  // roscpp ends at SIGINT only; a node that does not unregister stays known to the core.
  ros::init(argc, argv, argv[1], ros::init_options::AnonymousName | ros::init_options::NoSigintHandler);
  struct sigaction action = {};
  action.sa_handler = [](int) { ros::requestShutdown(); };
  sigaction(SIGINT, &action, nullptr);
  sigaction(SIGTERM, &action, nullptr);
}
