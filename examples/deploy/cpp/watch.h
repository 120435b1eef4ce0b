// Finds what is wrong with a robot's measurements: late, wrong, repeated, or beyond limits.
#pragma once

#include <set>

#include "limits.h"
#include "robot_link.h"

namespace ksim {

// The angle between a root's z axis and the vertical, rad.
inline double tilt_of(const Numbers& root_quat) {
  const double z = to_root_axes(root_quat, down)[2];
  return std::acos(std::min(1.0, std::max(-1.0, -z)));
}

// Each method throws a Fault with one line that names what is wrong.
class Watch {
 public:
  Watch(const Joints& joints, const Limits& limits, double period)
      : longest(limits.late_periods * period), joints_(joints), limits_(limits) {}

  // Refuse a measurement that is missing, late, stamped by another clock, repeated, incomplete or not finite.
  void message(double now, const std::optional<Measurement>& measurement) {
    if (!measurement) throw Fault("no message from the robot");
    const double age = now - measurement->stamp;
    if (age > longest) {
      throw Fault(text("no message from the robot for %.3f s: expected one in %.3f s", age, longest));
    }
    // By such a clock no message would ever be late. A stamp that is NaN comes here, too.
    if (!(age >= -longest)) {
      throw Fault(text("a message's stamp is %.3f s ahead of the loop: expected s of CLOCK_MONOTONIC", -age));
    }
    check_numbers(*measurement);
    check_news(*measurement);
  }

  // Refuse joints that are out of their limits, or too fast, and a robot that falls.
  void motion(const Measurement& measurement) const {
    for (size_t k = 0; k < joints_.size(); ++k) {
      const double low = joints_.lowest[k] - limits_.position_margin;
      const double high = joints_.highest[k] + limits_.position_margin;
      const double pos = measurement.joint_pos[k];
      if (pos >= low && pos <= high) continue;
      throw Fault(text("%s is at %.3f: expected %.3f to %.3f", joints_.names[k].c_str(), pos, low, high));
    }
    for (size_t k = 0; k < joints_.size(); ++k) {
      const double own = joints_.most_speed[k];
      const double most = std::isinf(own) ? limits_.most_speed : own;
      const double speed = std::abs(measurement.joint_vel[k]);
      if (speed <= most) continue;
      throw Fault(text("%s moves with %.1f per s: expected at most %.1f", joints_.names[k].c_str(), speed, most));
    }
    if (!measurement.root_quat) return;
    const double tilt = tilt_of(*measurement.root_quat);
    if (tilt <= limits_.most_tilt) return;
    const double degree = std::acos(-1.0) / 180.0;
    throw Fault(text("tilted by %.0f degrees: expected at most %.0f", tilt / degree, limits_.most_tilt / degree));
  }

  const double longest;  // s, without a new message

 private:
  void check_numbers(const Measurement& measurement) {
    check_given("root_quat", measurement.root_quat.has_value());
    check_given("root_ang_vel", measurement.root_ang_vel.has_value());
    check_given("count", measurement.count.has_value());
    check_joints("joint_pos", measurement.joint_pos);
    check_joints("joint_vel", measurement.joint_vel);
    check_joints("joint_effort", measurement.joint_effort);
    if (measurement.root_quat) check_array("root_quat", *measurement.root_quat, 4);
    if (measurement.root_ang_vel) check_array("root_ang_vel", *measurement.root_ang_vel, 3);
    for (const auto& [name, values] : measurement.estimates) {
      estimated_.insert(name);
      check_array(name, values, values.size());
    }
    for (const auto& name : estimated_) check_given(name, measurement.estimates.count(name) != 0);
    if (!measurement.root_quat) return;
    double sum = 0.0;
    for (double value : *measurement.root_quat) sum += value * value;
    const double length = std::sqrt(sum);
    if (length >= 0.99 && length <= 1.01) return;
    throw Fault(text("root_quat has the length %.3f: expected 1", length));
  }

  // What watches it would see nothing any more.
  void check_given(const std::string& what, bool is_given) {
    if (is_given) given_.insert(what);
    if (is_given || given_.count(what) == 0) return;
    throw Fault("no " + what + " in a message: the ones before had it");
  }

  void check_joints(const char* what, const Numbers& values) const {
    check_size(what, values, joints_.size());
    for (size_t k = 0; k < values.size(); ++k) {
      if (std::isfinite(values[k])) continue;
      throw Fault(text("%s of %s is %f", what, joints_.names[k].c_str(), values[k]));
    }
  }

  static void check_size(const std::string& what, const Numbers& values, size_t size) {
    if (values.size() == size) return;
    throw Fault(what + text(" has the shape (%zu,): expected (%zu,)", values.size(), size));
  }

  static void check_array(const std::string& what, const Numbers& values, size_t size) {
    check_size(what, values, size);
    for (double value : values) {
      if (!std::isfinite(value)) throw Fault(what + " is [" + as_words(values) + "]");
    }
  }

  // Refuse a state that a firmware sends again and again, in messages that are new.
  void check_news(const Measurement& measurement) {
    // By the stamps of the messages: where none comes any more, the last one is late.
    const double stamp = measurement.stamp;
    if (!measurement.count || measurement.count != count_) {
      count_ = measurement.count;
      counted_at_ = stamp;
    }
    const double stood = stamp - counted_at_;
    if (stood > longest) {
      throw Fault(text("the robot sends one state again and again: its count is %lld for %.3f s", *count_, stood));
    }
    // Encoders of a robot at rest may read the same for long; a gyroscope has noise.
    if (!measurement.root_ang_vel) return;
    Numbers readings = measurement.joint_pos;
    const auto add = [&readings](const Numbers& values) { readings.insert(readings.end(), values.begin(), values.end()); };
    add(measurement.joint_vel);
    add(measurement.joint_effort);
    add(*measurement.root_ang_vel);
    if (measurement.root_quat) add(*measurement.root_quat);
    if (readings != readings_) {
      readings_ = readings;
      changed_at_ = stamp;
    }
    const double same = stamp - changed_at_;
    if (same <= limits_.same_seconds) return;
    throw Fault(text("the robot has measured the same for %.3f s, its gyroscope too: does it send one state again and "
                     "again?",
                     same));
  }

  const Joints& joints_;
  Limits limits_;
  std::set<std::string> given_;
  std::set<std::string> estimated_;
  std::optional<long long> count_;
  double counted_at_ = 0.0;
  Numbers readings_;
  double changed_at_ = 0.0;
};

// Returns a line for each thing that nothing limits, holds or brakes.
inline Names unguarded(const Joints& joints, const Measurement& measurement) {
  Names efforts, stiffnesses, dampings;
  for (size_t k = 0; k < joints.size(); ++k) {
    if (!joints.driven[k]) continue;
    if (std::isinf(joints.most_effort[k])) efforts.push_back(joints.names[k]);
    if (joints.stiffness[k] == 0.0) stiffnesses.push_back(joints.names[k]);
    if (joints.damping[k] == 0.0) dampings.push_back(joints.names[k]);
  }
  Names lines;
  if (!efforts.empty()) lines.push_back("no limit of effort: " + joined(efforts));
  if (!stiffnesses.empty()) {
    lines.push_back("no stiffness, so that nothing holds them in stand: " + joined(stiffnesses));
  }
  if (!dampings.empty()) lines.push_back("no damping, so that nothing brakes them: " + joined(dampings));
  if (!measurement.root_quat) lines.push_back("no attitude: the tilt is not watched");
  if (!measurement.root_ang_vel && !measurement.count) {
    lines.push_back("no gyroscope and no count: a state that is sent again and again is not noticed");
  }
  return lines;
}

}  // namespace ksim
