// The options of loop.py that your own robot needs.
#pragma once

#include <cstring>

#include "limits.h"

namespace ksim {

struct Options {
  std::string folder;
  Limits limits;
  Times times;
  double seconds = 0.0;  // of the policy, without an operator; 0: words lead from state to state
  bool dry_run = false;  // end behind the first dry run; a robot is sent nothing
  bool real_time = true;
  std::string log;
  std::string report;
  int port = 0;  // of a robot that speaks as udp_robot.h does
};

inline double number_of(const std::string& option, const char* value) {
  const std::optional<double> found = number_in(value);
  if (!found) throw std::runtime_error(option + " " + value + ": expected a number");
  return *found;
}

inline Options parse_options(int count, char** arguments) {
  check_locale();
  Options options;
  double port = 0.0;
  std::vector<NumberOption> numbers = number_options(options.limits, options.times);
  numbers.push_back({"--seconds", &options.seconds, 0.0});
  numbers.push_back({"--port", &port, 0.0, 65535.0});
  for (int k = 1; k < count; ++k) {
    const std::string word = arguments[k];
    if (word == "--dry-run") {
      options.dry_run = true;
      continue;
    }
    if (word == "--no-real-time") {
      options.real_time = false;
      continue;
    }
    if (word.rfind("--", 0) != 0) {
      if (!options.folder.empty()) throw std::runtime_error(word + ": expected one folder");
      options.folder = word;
      continue;
    }
    if (k + 1 == count) throw std::runtime_error(word + ": expected a value");
    const char* value = arguments[++k];
    if (word == "--log") {
      options.log = value;
      continue;
    }
    if (word == "--report") {
      options.report = value;
      continue;
    }
    const auto is_meant = [&word](const NumberOption& number) { return word == number.name; };
    const auto number = std::find_if(numbers.begin(), numbers.end(), is_meant);
    if (number == numbers.end()) throw std::runtime_error(word + ": no such option");
    *number->value = number_of(word, value);
    number->check();
  }
  if (options.folder.empty()) throw std::runtime_error("expected the folder of an export");
  if (options.dry_run && options.seconds > 0.0) {
    throw std::runtime_error("--seconds: a dry run has --dry-seconds: leave out one of the two");
  }
  if (port != std::floor(port)) throw std::runtime_error(text("--port %g: expected a whole number", port));
  options.port = static_cast<int>(port);
  return options;
}

}  // namespace ksim
