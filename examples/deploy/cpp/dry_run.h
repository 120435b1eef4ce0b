// Runs a policy dry: on what a robot measures, while its motors do something else, to see what it would ask for.
#pragma once

#include "deadlines.h"
#include "effort_limit.h"
#include "policy_control.h"

namespace ksim {

// Steps of a policy whose commands are looked at, and not sent.
class DryRun {
 public:
  using Now = double (*)();

  DryRun(PolicyControl& control, double period, double seconds, double margin, Now now)
      : control_(control), joints_(control.joints), period_(period), margin_(margin), now_(now) {
    // Of more, a long would not hold the number: they take days.
    num_steps_ = std::max(1L, std::lround(std::min(seconds / period, 1e9)));
    begin();
  }

  // Begin an episode of the policy, and forget the last dry run.
  void begin() {
    control_.begin();
    steps_ = 0;
    took_ = Durations();
    const size_t size = joints_.size();
    least_.assign(size, infinity);
    most_.assign(size, -infinity);
    most_effort_.assign(size, 0.0);
    sum_of_pos_.assign(size, 0.0);
    measured_.assign(size, 0.0);
  }

  bool is_over() const { return steps_ >= num_steps_; }

  // Run one step, and return what it would have asked of the motors.
  JointCommand operator()(const Measurement& measurement) {
    const double began = now_();
    const JointCommand asked = control_(measurement);
    took_.add(now_() - began);
    check_finite(asked, joints_);
    ++steps_;
    for (size_t k = 0; k < joints_.size(); ++k) {
      double effort = asked.effort[k] + asked.stiffness[k] * (asked.pos[k] - measurement.joint_pos[k]);
      effort += asked.damping[k] * (asked.vel[k] - measurement.joint_vel[k]);
      least_[k] = std::min(least_[k], asked.pos[k]);
      most_[k] = std::max(most_[k], asked.pos[k]);
      most_effort_[k] = std::max(most_effort_[k], std::abs(effort));
      sum_of_pos_[k] += asked.pos[k];
    }
    measured_ = measurement.joint_pos;
    return asked;
  }

  // What the policy would have asked for: a line about time, and one for each joint with a motor.
  Names lines() const {
    Names found = {text("dry run: %ld steps of %.2f ms, 99 %% of them within %.2f ms; a period has %g ms", steps_,
                        1e3 * took_.quantile(0.5), 1e3 * took_.quantile(0.99), 1e3 * period_)};
    for (size_t k = 0; k < joints_.size(); ++k) {
      if (!joints_.driven[k]) continue;
      const bool is_beyond = least_[k] < joints_.lowest[k] || most_[k] > joints_.highest[k];
      found.push_back(text("dry run: %s is at %.3f, would be asked for %.3f to %.3f of %.3f to %.3f, with %.3g of %.3g%s",
                           joints_.names[k].c_str(), measured_[k], least_[k], most_[k], joints_.lowest[k],
                           joints_.highest[k], most_effort_[k], joints_.most_effort[k],
                           is_beyond ? ": beyond its limits" : ""));
    }
    return found;
  }

  // Throw a Fault where the policy was too slow, or asked a robot that stands for what its joints cannot do. From
  // another pose than it has learned in, a policy may ask for anything: there only its time counts.
  void check(bool stands) const {
    const double slow = took_.quantile(0.99);
    if (slow > most_share * period_) {
      throw Fault(text("dry run: 1 %% of the policy's steps took %.1f ms or more: expected at most %.1f ms of a period of "
                       "%g ms",
                       1e3 * slow, 1e3 * most_share * period_, 1e3 * period_));
    }
    if (!stands) return;
    for (size_t k = 0; k < joints_.size(); ++k) {
      // The mean, as a short push may lead beyond a limit: the motor only pulls harder for it.
      const double pos = sum_of_pos_[k] / static_cast<double>(steps_);
      const double low = joints_.lowest[k] - margin_;
      const double high = joints_.highest[k] + margin_;
      if (pos >= low && pos <= high) continue;
      throw Fault(text("dry run: the policy would ask %s for %.3f in the mean: expected %.3f to %.3f",
                       joints_.names[k].c_str(), pos, low, high));
    }
  }

 private:
  static constexpr double most_share = 0.8;  // of a period: reading, writing and the log need the rest

  PolicyControl& control_;
  const Joints& joints_;
  double period_;
  double margin_;
  Now now_;
  long num_steps_ = 1;
  long steps_ = 0;
  Durations took_;
  Numbers least_;
  Numbers most_;
  Numbers most_effort_;
  Numbers sum_of_pos_;
  Numbers measured_;
};

}  // namespace ksim
