// Reads a robot's messages, lines of text: for udp_robot.h and replay.cpp.
#pragma once

#include <cstdlib>
#include <sstream>

#include "robot_link.h"

namespace ksim {

inline Names fields_of(const std::string& line) {
  Names fields;
  std::istringstream parts(line);
  for (std::string part; parts >> part;) fields.push_back(part);
  return fields;
}

inline Names split(const std::string& list, char mark) {
  Names parts;
  std::istringstream stream(list);
  for (std::string part; std::getline(stream, part, mark);) parts.push_back(part);
  return parts;
}

// Returns the numbers of a list with commas. A broken one is an error: as a zero, a joint would be somewhere else.
inline Numbers numbers_in(const std::string& what, const std::string& list) {
  Numbers found;
  for (const auto& part : split(list, ',')) {
    const std::optional<double> value = number_in(part);
    if (!value) throw std::runtime_error(what + " has '" + part + "' in a message: expected a number");
    found.push_back(*value);
  }
  return found;
}

inline std::optional<Numbers> numbers_if_any(const std::string& what, const std::string& list) {
  if (list == "-") return std::nullopt;
  return numbers_in(what, list);
}

// Returns the measurement of fields from a first one on: `COUNT POS VEL EFFORT QUAT ANG_VEL [NAME=NUMBERS]...`, lists
// with commas, and `-` for a count, an attitude or a gyroscope that a robot has not.
inline Measurement measurement_of(const Names& fields, size_t first, double stamp) {
  if (fields.size() < first + 6) throw std::runtime_error(text("a message of %zu fields", fields.size()));
  Measurement found;
  found.stamp = stamp;
  const std::string& count = fields[first];
  if (count != "-") {
    const double value = numbers_in("count", count).at(0);
    // Beyond these a double has no whole numbers of its own, and NaN comes here, too.
    if (!(std::abs(value) <= 9e15)) throw std::runtime_error("count is " + count + " in a message");
    found.count = static_cast<long long>(value);
  }
  found.joint_pos = numbers_in("joint_pos", fields[first + 1]);
  found.joint_vel = numbers_in("joint_vel", fields[first + 2]);
  found.joint_effort = numbers_in("joint_effort", fields[first + 3]);
  found.root_quat = numbers_if_any("root_quat", fields[first + 4]);
  found.root_ang_vel = numbers_if_any("root_ang_vel", fields[first + 5]);
  for (size_t k = first + 6; k < fields.size(); ++k) {
    const size_t mark = fields[k].find('=');
    if (mark == std::string::npos) throw std::runtime_error("'" + fields[k] + "' in a message: expected NAME=NUMBERS");
    const std::string name = fields[k].substr(0, mark);
    found.estimates[name] = numbers_in(name, fields[k].substr(mark + 1));
  }
  return found;
}

}  // namespace ksim
