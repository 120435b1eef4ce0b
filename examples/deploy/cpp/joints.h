// The joints of export.json: gains, the pose that a policy stands in, and what they may not pass.
#pragma once

#include <algorithm>
#include <limits>

#include "json.h"

namespace ksim {

inline constexpr double infinity = std::numeric_limits<double>::infinity();

// A joint without a motor has no stiffness and no damping; what has no limit has an infinite one.
struct Joints {
  explicit Joints(const Json& meta) {
    const Json& joints = meta["joints"];
    names = joints["names"].texts();
    default_pos = of_each(joints["default_pos"], -infinity);
    stiffness = of_each(joints["stiffness"], 0.0);
    damping = of_each(joints["damping"], 0.0);
    effort_scale = of_each(joints["effort_scale"], -infinity);
    const Json& limits = joints["limits"];
    const Json& positions = limits["position"];
    check_size(positions, positions.list().size());
    for (const auto& pair : positions.list()) {
      check_size(pair, pair.list().size(), 2);
      lowest.push_back(pair.list()[0].number_or(-infinity));
      highest.push_back(pair.list()[1].number_or(infinity));
    }
    most_effort = limits_of(limits["effort"]);
    most_speed = limits_of(limits["velocity"]);
    for (size_t k = 0; k < names.size(); ++k) check_order("position", k, lowest[k], highest[k]);
    const Names asked = meta["joint_names"].texts();
    for (size_t k = 0; k < names.size(); ++k) {
      const bool is_asked = std::find(asked.begin(), asked.end(), names[k]) != asked.end();
      driven.push_back(is_asked || stiffness[k] > 0.0 || damping[k] > 0.0);
    }
  }

  size_t size() const { return names.size(); }

  // The places of some joints.
  std::vector<size_t> columns(const Names& wanted) const {
    std::vector<size_t> places;
    for (const auto& name : wanted) {
      const auto found = std::find(names.begin(), names.end(), name);
      if (found == names.end()) throw std::runtime_error("export.json: there is no joint " + name);
      places.push_back(static_cast<size_t>(found - names.begin()));
    }
    return places;
  }

  Names names;
  Numbers default_pos;
  Numbers stiffness;
  Numbers damping;
  Numbers effort_scale;  // what a target of effort is in the model, a motor exerts at its joint
  Numbers lowest;
  Numbers highest;
  Numbers most_effort;
  Numbers most_speed;
  std::vector<bool> driven;

 private:
  void check_size(const Json& entry, size_t size) const { check_size(entry, size, names.size()); }

  static void check_size(const Json& entry, size_t size, size_t wanted) {
    if (size != wanted) throw std::runtime_error(entry.place + text(": %zu entries: expected %zu", size, wanted));
  }

  void check_order(const char* what, size_t place, double low, double high) const {
    if (low <= high) return;
    throw std::runtime_error(text("export.json: joints.limits.%s of '%s' is %g: expected %g or more", what,
                                  names[place].c_str(), high, low));
  }

  Numbers of_each(const Json& entry, double least) const {
    const Numbers values = entry.numbers();
    check_size(entry, values.size());
    for (size_t k = 0; k < values.size(); ++k) {
      if (values[k] >= least) continue;
      throw std::runtime_error(entry.place + " of " + names[k] + text(" is %g: expected %g or more", values[k], least));
    }
    return values;
  }

  Numbers limits_of(const Json& entry) const {
    Numbers found;
    for (const auto& value : entry.list()) found.push_back(value.number_or(infinity));
    check_size(entry, found.size());
    for (size_t k = 0; k < found.size(); ++k) {
      if (found[k] < 0.0) throw std::runtime_error(entry.place + " of " + names[k] + " is below 0");
    }
    return found;
  }
};

}  // namespace ksim
