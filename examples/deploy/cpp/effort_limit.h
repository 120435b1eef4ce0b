// Keeps what motors are asked for within their effort limits at the measured state.
#pragma once

#include "joints.h"
#include "robot_link.h"

namespace ksim {

// Refuse a command that a policy made of numbers beyond all bounds.
inline void check_finite(const JointCommand& command, const Joints& joints) {
  const std::pair<const char*, const Numbers*> fields[] = {{"pos", &command.pos},
                                                           {"vel", &command.vel},
                                                           {"effort", &command.effort},
                                                           {"stiffness", &command.stiffness},
                                                           {"damping", &command.damping}};
  for (const auto& [name, values] : fields) {
    for (size_t k = 0; k < values->size(); ++k) {
      if (std::isfinite((*values)[k])) continue;
      throw Fault(text("the policy's target of %s (%s) is not finite", joints.names[k].c_str(), name));
    }
  }
}

// Targets of positions are moved, to between the measured position and the target. Where damping and effort alone are
// beyond the limit, all of a joint's command is made smaller: a target, or an effort, that made up for a brake that is
// too strong would drive the joint as soon as it stands still.
class EffortLimit {
 public:
  EffortLimit(const Joints& joints, double share) : counts(joints.size(), 0), most_(joints.most_effort) {
    for (double& most : most_) most *= share;
  }

  JointCommand operator()(JointCommand command, const Measurement& measurement) {
    for (size_t k = 0; k < most_.size(); ++k) {
      const double away = command.pos[k] - measurement.joint_pos[k];
      const double faster = command.vel[k] - measurement.joint_vel[k];
      const double others = command.effort[k] + command.damping[k] * faster;
      const double effort = command.stiffness[k] * away + others;
      const double within = std::min(std::max(effort, -most_[k]), most_[k]);
      // NaN differs from itself, and is left for `check_finite`.
      if (effort == within) continue;
      ++counts[k];
      if (std::abs(others) <= most_[k]) {
        command.pos[k] += (within - effort) / command.stiffness[k];
        continue;
      }
      const double share = within / effort;
      command.effort[k] *= share;
      command.stiffness[k] *= share;
      command.damping[k] *= share;
    }
    return command;
  }

  std::vector<long> counts;  // of commands that were moved, by joint

 private:
  Numbers most_;
};

}  // namespace ksim
