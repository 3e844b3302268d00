// The programs of the experiments by roscpp: "PROGRAM NAME ARGUMENT...", with the names and arguments of the
// programs in Python. They tell the same.

#include <cstdio>
#include <exception>
#include <map>
#include <string>

#include "listener.hpp"
#include "program.hpp"
#include "sources.hpp"
#include "trips.hpp"

int main(int argc, char** argv) {
  const std::map<std::string, void (*)(const Arguments&)> programs = {
      {"asker", ask}, {"camera", camera}, {"echo", echo}, {"listener", listen}, {"robots", robots}};
  const auto found = programs.find(argc > 1 ? argv[1] : "");
  if (found == programs.end()) {
    std::fprintf(stderr, "the first argument is the name of a program\n");
    return 2;
  }
  try {
    start_node(argc, argv);
    found->second(Arguments::of(argc, argv));
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", argv[1], error.what());
    return 1;
  }
  return 0;
}
