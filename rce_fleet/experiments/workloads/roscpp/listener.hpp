// Takes topics, prints them where it is asked to, and notes when; as workloads/listener.py.

#pragma once

#include <map>
#include <mutex>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "control.hpp"
#include "program.hpp"
#include "telling.hpp"

class Listener {
 public:
  template <class Message>
  void subscribe(ros::NodeHandle& node, const std::string& topic) {
    missing_.insert(topic);
    using Pointer = boost::shared_ptr<const Message>;
    const boost::function<void(const Pointer&)> take = [this, topic](const Pointer& message) {
      this->take(topic, *message);
    };
    subscribers_.push_back(node.subscribe<Message>(topic, QUEUE, take));
  }

 private:
  template <class Message>
  void take(const std::string& topic, const Message& message) {
    const auto [phase, mode] = phase_of(message.header.frame_id);
    const std::lock_guard lock(mutex_);
    if (mode == PRINTED) {
      show(message);
    }
    const std::int64_t now = now_us();
    if (mode == END) {
      open_.erase(topic);
      if (open_.empty() && !is_told_) {
        tell_taken();
      }
    } else {
      open_.insert(topic);
      const auto& stamp = message.header.stamp;
      samples_[{phase, topic}].emplace_back(stamp.sec * std::int64_t{1000000} + stamp.nsec / 1000, now);
    }
    if (missing_.erase(topic) != 0 && missing_.empty()) {
      tell_ready();
    }
  }

  void tell_taken() {
    is_told_ = true;
    for (const auto& [key, samples] : samples_) {
      tell_samples(key.first, key.second, samples);
    }
    tell_end();
  }

  std::mutex mutex_;
  std::set<std::string> missing_;
  // Topics that have had a message, but not their last one.
  std::set<std::string> open_;
  std::map<std::pair<std::string, std::string>, std::vector<Sample>> samples_;
  std::vector<ros::Subscriber> subscribers_;
  bool is_told_ = false;
};

inline void listen(const Arguments& arguments) {
  ros::NodeHandle node;
  Listener listener;
  for (const std::string& word : arguments.words) {
    const auto at = word.find('=');
    const std::string topic = word.substr(0, at), type = word.substr(at + 1);
    if (type == "sensor_msgs/LaserScan") {
      listener.subscribe<sensor_msgs::LaserScan>(node, topic);
    } else if (type == "sensor_msgs/Image") {
      listener.subscribe<sensor_msgs::Image>(node, topic);
    } else if (type == "sensor_msgs/CompressedImage") {
      listener.subscribe<sensor_msgs::CompressedImage>(node, topic);
    } else {
      throw std::invalid_argument(word + ": this type is not known");
    }
  }
  run([] { return 0.1; });
}
