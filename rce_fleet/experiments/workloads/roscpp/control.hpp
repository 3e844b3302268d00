// What a source shall send now: a file that the experiment replaces; as workloads/control.py.

#pragma once

#include <sys/stat.h>

#include <string>
#include <tuple>
#include <utility>

#define BOOST_BIND_GLOBAL_PLACEHOLDERS  // which its parser of JSON uses
#include <boost/property_tree/json_parser.hpp>
#include <boost/property_tree/ptree.hpp>

inline const std::string PRINTED = "printed", QUIET = "quiet", END = "end", START = "start";

struct Phase {
  std::string name = START;
  std::string mode = QUIET;
  double rate = 5.0;
  std::string stream;
  double work_s = 0.0;

  bool is_small() const { return mode == END || name == START; }
  std::string frame() const { return name + '/' + mode; }
  bool operator!=(const Phase& other) const {
    return std::tie(name, mode, rate, stream, work_s) !=
           std::tie(other.name, other.mode, other.rate, other.stream, other.work_s);
  }
};

// Name and mode of the phase that a message with this frame is part of.
inline std::pair<std::string, std::string> phase_of(const std::string& frame) {
  const auto at = frame.find('/');
  return {frame.substr(0, at), at == std::string::npos ? "" : frame.substr(at + 1)};
}

class Control {
 public:
  explicit Control(std::string path) : path_(std::move(path)) {}

  const Phase& read() {
    struct stat found;
    if (stat(path_.c_str(), &found) != 0) {
      return phase_;
    }
    const std::pair changed(found.st_mtim.tv_sec, found.st_mtim.tv_nsec);
    if (changed != changed_) {
      boost::property_tree::ptree values;
      boost::property_tree::read_json(path_, values);
      changed_ = changed;
      phase_ = {values.get<std::string>("name"), values.get<std::string>("mode"), values.get<double>("rate"),
                values.get<std::string>("stream"), values.get<double>("work_s")};
    }
    return phase_;
  }

 private:
  std::string path_;
  std::pair<time_t, long> changed_;
  Phase phase_;
};
