// The programs "asker" and "echo" of round trips; as workloads/asker.py and workloads/echo.py.

#pragma once

#include <array>
#include <cstdio>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <std_msgs/String.h>

#include "program.hpp"
#include "telling.hpp"

constexpr double POLL_S = 0.05;
// Size of the smallest message, bytes.
constexpr int DIGITS = 7;
constexpr int NUMBERS = 10000000;
// After so many seconds the first message is sent again: it is lost until all are connected.
constexpr double FIRST_S = 0.5;
// Up to this size the first trip of a size is not counted.
constexpr int WARMED_UP_BYTES = 100000;

class Asker {
 public:
  Asker(ros::Publisher publisher, const std::vector<std::string>& sizes, double patience)
      : publisher_(std::move(publisher)), patience_(patience) {
    for (const std::string& text : sizes) {
      const int size = std::stoi(text), trips = std::stoi(text.substr(text.find(':') + 1));
      plan_.insert(plan_.end(), static_cast<std::size_t>(trips + (size <= WARMED_UP_BYTES)), size);
      trips_[size];
    }
  }

  void take(const std_msgs::String& message) {
    const double now = monotonic_s();
    const std::lock_guard lock(mutex_);
    if (is_told_ || message_.data.empty() || message.data.compare(0, DIGITS, message_.data, 0, DIGITS) != 0) {
      return;
    }
    if (number_ < 0) {
      tell_ready();
    }
    note(now - sent_at_);
    next();
  }

  double step() {
    const std::lock_guard lock(mutex_);
    const double waited = monotonic_s() - sent_at_;
    if (is_told_) {
      return POLL_S;
    }
    if (number_ < 0 && waited > FIRST_S) {
      send(DIGITS);
    } else if (number_ >= 0 && waited > patience_) {
      note(std::nullopt);
      next();
    }
    return POLL_S;
  }

 private:
  void next() {
    ++number_;
    if (number_ < static_cast<int>(plan_.size())) {
      send(plan_[static_cast<std::size_t>(number_)]);
      return;
    }
    is_told_ = true;
    for (const auto& [size, found] : trips_) {
      std::string trips;
      int lost = 0;
      for (std::size_t number = size <= WARMED_UP_BYTES; number < found.size(); ++number) {
        if (found[number]) {
          std::array<char, 64> trip;
          std::snprintf(trip.data(), trip.size(), "%s%.9f", trips.empty() ? "" : ", ", *found[number]);
          trips += trip.data();
        } else {
          ++lost;
        }
      }
      tell("\"bytes\": " + std::to_string(size) + ", \"trips\": [" + trips +
           "], \"lost\": " + std::to_string(lost));
    }
    tell_end();
  }

  void note(std::optional<double> trip) {
    if (number_ >= 0) {
      trips_[plan_[static_cast<std::size_t>(number_)]].push_back(trip);
    }
  }

  void send(int size) {
    std::array<char, 16> digits;
    std::snprintf(digits.data(), digits.size(), "%0*d", DIGITS, (number_ + NUMBERS) % NUMBERS);
    message_.data = digits.data();
    if (size > DIGITS) {
      message_.data.resize(static_cast<std::size_t>(size), 'x');
    }
    sent_at_ = monotonic_s();
    publisher_.publish(message_);
  }

  ros::Publisher publisher_;
  double patience_;
  std::mutex mutex_;
  std::vector<int> plan_;
  // Those of each size, seconds; none: lost.
  std::map<int, std::vector<std::optional<double>>> trips_;
  // Of the message under way; -1: the first one, which finds out whether all are connected.
  int number_ = -1;
  std_msgs::String message_;
  double sent_at_ = 0.0;
  bool is_told_ = false;
};

using StringCallback = boost::function<void(const std_msgs::String::ConstPtr&)>;

inline void ask(const Arguments& arguments) {
  ros::NodeHandle node;
  const auto& words = arguments.words;
  const std::string there = arguments.word(0), back = arguments.word(1);
  Asker asker(node.advertise<std_msgs::String>(there, QUEUE), {words.begin() + 2, words.end()},
              std::stod(arguments.option("patience")));
  const StringCallback take = [&asker](const std_msgs::String::ConstPtr& message) { asker.take(*message); };
  const auto subscriber = node.subscribe<std_msgs::String>(back, QUEUE, take);
  run([&asker] { return asker.step(); });
}

inline void echo(const Arguments& arguments) {
  ros::NodeHandle node;
  const auto publisher = node.advertise<std_msgs::String>(arguments.word(1), QUEUE);
  const StringCallback take = [&publisher](const std_msgs::String::ConstPtr& message) {
    publisher.publish(message);
  };
  const auto subscriber = node.subscribe<std_msgs::String>(arguments.word(0), QUEUE, take);
  run([] { return 0.1; });
}
