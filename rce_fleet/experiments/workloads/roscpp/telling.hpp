// What a program tells by its standard output; as rce_fleet/experiments/workloads/telling.py.

#pragma once

#include <algorithm>
#include <array>
#include <charconv>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <mutex>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include <sensor_msgs/CompressedImage.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/LaserScan.h>

// Stamp of a message, and when it arrived (0: not told), microseconds since 1970.
using Sample = std::pair<std::int64_t, std::int64_t>;

// Samples in one line: more are told in several.
constexpr std::size_t LONGEST = 500;

inline std::int64_t now_us() {
  const auto now = std::chrono::system_clock::now().time_since_epoch();
  return std::chrono::duration_cast<std::chrono::microseconds>(now).count();
}

// Seconds of a clock that never goes back.
inline double monotonic_s() {
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  return std::chrono::duration<double>(now).count();
}

template <class Number>
void append(std::string& text, Number number) {
  std::array<char, 32> digits;
  const auto end = std::to_chars(digits.data(), digits.data() + digits.size(), number);
  text.append(digits.data(), end.ptr);
}

inline std::string quoted(const std::string& text) {
  std::string found = "\"";
  for (const char character : text) {
    if (character == '"' || character == '\\') {
      found += '\\';
    }
    found += character;
  }
  return found + '"';
}

// Writes whole lines at once: threads must not mix theirs.
inline void put(const std::string& lines) {
  static std::mutex mutex;
  const std::lock_guard lock(mutex);
  std::fwrite(lines.data(), 1, lines.size(), stdout);
  std::fflush(stdout);
}

// Tells a report: the members of a JSON object. It begins a new line, as standard error may be the same file.
inline void tell(const std::string& members) { put("\nreport {" + members + "}\n"); }

inline void tell_end() { tell("\"phase\": \"end\""); }

inline void tell_ready() {
  std::array<char, 64> report;
  std::snprintf(report.data(), report.size(), "\"ready\": %.6f", static_cast<double>(now_us()) * 1e-6);
  put("\nready\n");
  tell(report.data());
}

inline void tell_samples(const std::string& phase, const std::string& topic,
                         const std::vector<Sample>& samples) {
  std::size_t begin = 0;
  do {
    std::string report = "\"phase\": " + quoted(phase) + ", \"topic\": " + quoted(topic) + ", \"samples\": [";
    const auto end = std::min(samples.size(), begin + LONGEST);
    for (auto number = begin; number < end; ++number) {
      report += number == begin ? "[" : ", [";
      append(report, samples[number].first);
      if (samples[number].second != 0) {
        report += ", ";
        append(report, samples[number].second);
      }
      report += ']';
    }
    tell(report + ']');
    begin = end;
  } while (begin < samples.size());
}

// A number of a message as "rostopic echo" prints it.
template <class Number>
void print(std::string& text, Number number) {
  if constexpr (std::is_same_v<Number, float>) {
    const auto begin = text.size();
    append(text, static_cast<double>(number));  // rospy's numbers are doubles
    if (text.find_first_of(".en", begin) == std::string::npos) {
      text += ".0";
    }
  } else {
    append(text, static_cast<std::int64_t>(number));
  }
}

template <class Number>
void print(std::string& text, const char* name, Number number) {
  text.append(name).append(": ");
  print(text, number);
  text += '\n';
}

inline void print(std::string& text, const char* name, const std::string& value) {
  text.append(name).append(": ").append(value.empty() ? "''" : quoted(value)) += '\n';
}

template <class Number>
void print(std::string& text, const char* name, const std::vector<Number>& numbers) {
  text.append(name).append(": [");
  const char* separator = "";
  for (const Number number : numbers) {
    text += separator;
    separator = ", ";
    print(text, number);
  }
  text += "]\n";
}

inline void print(std::string& text, const std_msgs::Header& header) {
  text += "header: \n";
  print(text, "  seq", header.seq);
  text += "  stamp: \n";
  print(text, "    secs", header.stamp.sec);
  std::array<char, 16> padded;
  std::snprintf(padded.data(), padded.size(), "%9u", header.stamp.nsec);
  text.append("    nsecs: ").append(padded.data()) += '\n';
  print(text, "  frame_id", header.frame_id);
}

inline void print(std::string& text, const sensor_msgs::LaserScan& scan) {
  print(text, scan.header);
  print(text, "angle_min", scan.angle_min);
  print(text, "angle_max", scan.angle_max);
  print(text, "angle_increment", scan.angle_increment);
  print(text, "time_increment", scan.time_increment);
  print(text, "scan_time", scan.scan_time);
  print(text, "range_min", scan.range_min);
  print(text, "range_max", scan.range_max);
  print(text, "ranges", scan.ranges);
  print(text, "intensities", scan.intensities);
}

inline void print(std::string& text, const sensor_msgs::Image& image) {
  print(text, image.header);
  print(text, "height", image.height);
  print(text, "width", image.width);
  print(text, "encoding", image.encoding);
  print(text, "is_bigendian", image.is_bigendian);
  print(text, "step", image.step);
  print(text, "data", image.data);
}

inline void print(std::string& text, const sensor_msgs::CompressedImage& image) {
  print(text, image.header);
  print(text, "format", image.format);
  print(text, "data", image.data);
}

// Prints a message as "rostopic echo" does, so that a console has as much to show as with rospy.
template <class Message>
void show(const Message& message) {
  std::string text;
  print(text, message);
  put(text + "---\n");
}
