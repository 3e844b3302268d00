// Sends messages of several topics at the rate that is asked for; as workloads/source.py.

#pragma once

#include <time.h>

#include <algorithm>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "control.hpp"
#include "program.hpp"
#include "telling.hpp"

// How often it looks at the phase, seconds.
constexpr double LOOK_S = 0.1;
// Rate at which it says that the last phase has ended.
constexpr double LAST_HZ = 5.0;

struct Stream {
  std::string name;
  std::string topic;
  // Sends the next message, or the small one, with a stamp and a frame.
  std::function<void(const ros::Time&, const std::string&, bool is_small)> send;
};

// Processor time of this thread, seconds.
inline double thread_s() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

// Uses so much processor time, seconds.
inline void work(double seconds) {
  const double end = thread_s() + seconds;
  while (thread_s() < end) {
  }
}

// A stream of messages that come again and again.
template <class Message>
Stream stream_of(ros::NodeHandle& node, const std::string& name, const std::string& topic,
                 std::vector<Message> messages, Message last) {
  auto publisher = node.advertise<Message>(topic, QUEUE);
  auto send = [publisher, messages = std::move(messages), last = std::move(last), next = std::size_t{0}](
                  const ros::Time& stamp, const std::string& frame, bool is_small) mutable {
    Message& message = is_small ? last : messages[next++ % messages.size()];
    message.header.stamp = stamp;
    message.header.frame_id = frame;
    publisher.publish(message);
  };
  return {name, topic, std::move(send)};
}

class Source {
 public:
  Source(std::vector<Stream> streams, const std::string& control)
      : streams_(std::move(streams)), control_(control), due_(monotonic_s()), phase_(control_.read()) {}

  double step() {
    const double now = monotonic_s();
    if (now >= look_at_) {
      look_at_ = now + LOOK_S;
      const Phase& phase = control_.read();
      if (phase != phase_) {
        tell_sent();
        phase_ = phase;
        due_ = now;
      }
    }
    if (now >= due_) {
      send();
      // What could not be sent in time is not made up for.
      due_ = std::max(due_ + 1.0 / (phase_.mode == END ? LAST_HZ : phase_.rate), now);
    }
    return std::max(0.0, std::min(due_, look_at_) - monotonic_s());
  }

 private:
  void tell_sent() {
    for (const auto& [key, samples] : sent_) {
      tell_samples(key.first, key.second, samples);
    }
    sent_.clear();
    if (control_.read().mode == END) {
      tell_end();
    }
  }

  void send() {
    for (Stream& stream : streams_) {
      if (!phase_.stream.empty() && stream.name != phase_.stream) {
        continue;
      }
      if (!phase_.is_small() && phase_.work_s > 0.0) {
        work(phase_.work_s);
      }
      const std::int64_t stamp = now_us();
      const ros::Time time(static_cast<std::uint32_t>(stamp / 1000000),
                           static_cast<std::uint32_t>(stamp % 1000000 * 1000));
      stream.send(time, phase_.frame(), phase_.is_small());
      if (!phase_.is_small()) {
        sent_[{phase_.name, stream.topic}].emplace_back(stamp, 0);
      }
    }
  }

  std::vector<Stream> streams_;
  Control control_;
  std::map<std::pair<std::string, std::string>, std::vector<Sample>> sent_;
  double due_;
  double look_at_ = 0.0;
  Phase phase_;
};
