// The programs "robots" and "camera"; as workloads/robots.py and workloads/camera.py.

#pragma once

#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <random>
#include <sstream>
#include <string>
#include <tuple>
#include <vector>

#include "source.hpp"

constexpr int RAYS = 640;
constexpr double FIELD_OF_VIEW = 57.0 * M_PI / 180.0;
// Different scans of a robot, which come again and again.
constexpr int SCENES = 16;

// A robot's scans: a wall with a bump, and noise.
inline std::vector<sensor_msgs::LaserScan> scans(unsigned robot) {
  std::mt19937 random(robot);
  std::normal_distribution<double> noise(0.0, 0.01);
  std::vector<sensor_msgs::LaserScan> found(SCENES);
  for (int scene = 0; scene < SCENES; ++scene) {
    const double bump = FIELD_OF_VIEW * (static_cast<double>(scene) / SCENES - 0.5);
    auto& scan = found[scene];
    scan.angle_min = -0.5 * FIELD_OF_VIEW;
    scan.angle_max = 0.5 * FIELD_OF_VIEW;
    scan.angle_increment = FIELD_OF_VIEW / (RAYS - 1);
    scan.scan_time = 1.0 / 30.0;
    scan.range_min = 0.45;
    scan.range_max = 10.0;
    for (int ray = 0; ray < RAYS; ++ray) {
      const double angle = FIELD_OF_VIEW * (static_cast<double>(ray) / (RAYS - 1) - 0.5);
      const double distance = std::abs(angle - bump) < 0.1 ? 2.5 : 4.0;
      scan.ranges.push_back(static_cast<float>(distance / std::cos(angle) + noise(random)));
    }
  }
  return found;
}

inline void robots(const Arguments& arguments) {
  ros::NodeHandle node;
  std::vector<Stream> streams;
  for (const std::string& number : arguments.words) {
    const auto robot = static_cast<unsigned>(std::stoul(number));
    streams.push_back(
        stream_of(node, number, "/Robot" + number + "/scan", scans(robot), sensor_msgs::LaserScan()));
  }
  Source source(std::move(streams), arguments.option("control"));
  run([&source] { return source.step(); });
}

using Fields = boost::property_tree::ptree;

inline void fill(sensor_msgs::Image& image, const Fields& fields) {
  image.height = fields.get<std::uint32_t>("height");
  image.width = fields.get<std::uint32_t>("width");
  image.encoding = fields.get<std::string>("encoding");
  image.step = fields.get<std::uint32_t>("step");
}

inline void fill(sensor_msgs::CompressedImage& image, const Fields& fields) {
  image.format = fields.get<std::string>("format");
}

// The last message of a type, where an empty one is not legal.
inline void make_small(sensor_msgs::Image& image) {
  image.height = image.width = 1;
  image.encoding = "rgb8";
  image.step = 3;
  image.data.assign(3, 0);
}

inline void make_small(sensor_msgs::CompressedImage&) {}

inline std::vector<std::uint8_t> content(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  file.exceptions(std::ios::badbit | std::ios::failbit);
  std::vector<std::uint8_t> found(std::filesystem::file_size(path));
  file.read(reinterpret_cast<char*>(found.data()), static_cast<std::streamsize>(found.size()));
  return found;
}

template <class Message>
Stream image_stream(ros::NodeHandle& node, const std::string& name, const std::string& topic,
                    const std::vector<Fields>& lines, const std::filesystem::path& folder) {
  std::vector<Message> messages;
  for (const Fields& line : lines) {
    Message& message = messages.emplace_back();
    fill(message, line.get_child("fields"));
    message.data = content(folder / line.get<std::string>("file"));
  }
  Message last;
  make_small(last);
  return stream_of(node, name, topic, std::move(messages), std::move(last));
}

inline void camera(const Arguments& arguments) {
  const std::filesystem::path listing = arguments.option("images");
  std::map<std::tuple<std::string, std::string, std::string>, std::vector<Fields>> found;
  std::ifstream file(listing);
  for (std::string line; std::getline(file, line);) {
    Fields image;
    std::istringstream text(line);
    boost::property_tree::read_json(text, image);
    found[{image.get<std::string>("stream"), image.get<std::string>("topic"), image.get<std::string>("type")}]
        .push_back(image);
  }
  ros::NodeHandle node;
  std::vector<Stream> streams;
  for (const auto& [key, images] : found) {
    const auto& [name, topic, type] = key;
    if (type == "sensor_msgs/Image") {
      streams.push_back(image_stream<sensor_msgs::Image>(node, name, topic, images, listing.parent_path()));
    } else if (type == "sensor_msgs/CompressedImage") {
      streams.push_back(
          image_stream<sensor_msgs::CompressedImage>(node, name, topic, images, listing.parent_path()));
    } else {
      throw std::invalid_argument("images of the type " + type + " are not known");
    }
  }
  Source source(std::move(streams), arguments.option("control"));
  run([&source] { return source.step(); });
}
