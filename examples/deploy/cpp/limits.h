// The limits of a robot's motion, and how long hand-overs last: options of the loop, as in loop.py.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "joints.h"

namespace ksim {

struct Limits {
  double late_periods = 3.0;     // without a new message, or by which the loop itself may be late
  double most_tilt = 1.0;        // rad, of the root's z axis from the vertical
  double position_margin = 0.2;  // beyond the limits of positions in export.json, rad or m
  double most_speed = 35.0;      // of joints without a speed limit in export.json, per s
  double same_seconds = 0.5;     // for which all that a robot with a gyroscope measures may be the same
  double effort_share = 1.0;     // of the effort limits in export.json
};

struct Times {
  double dry_seconds = 2.0;     // of the policy's dry runs, at the beginning and when the robot stands
  double stand_seconds = 2.0;   // from the measured pose to the default pose
  double blend_seconds = 0.5;   // from standing to the policy's targets
  double stop_seconds = 1.0;    // from the gains of the moment to none
  double damp_seconds = 2.0;    // of braking at the end
  double damping_factor = 2.0;  // of joint_damping in export.json, while motors only brake
};

// A number that an option sets, and what it may be.
struct NumberOption {
  const char* name;
  double* value;
  double least;
  double most = infinity;

  void check() const {
    // Written so that NaN is refused, too.
    if (*value >= least && *value <= most && *value < infinity) return;
    throw std::runtime_error(text("%s %g: expected %g to %g", name, *value, least, most));
  }
};

// The options of limits and times. A jump, motors that do not brake, and one lost message are none.
inline std::vector<NumberOption> number_options(Limits& limits, Times& times) {
  return {
      {"--late-periods", &limits.late_periods, 1.0},
      {"--most-tilt", &limits.most_tilt, 0.0},
      {"--position-margin", &limits.position_margin, 0.0},
      {"--most-speed", &limits.most_speed, 0.0},
      {"--same-seconds", &limits.same_seconds, 0.0},
      {"--effort-share", &limits.effort_share, 0.01, 1.0},
      {"--dry-seconds", &times.dry_seconds, 0.1},
      {"--stand-seconds", &times.stand_seconds, 0.1},
      {"--blend-seconds", &times.blend_seconds, 0.0},
      {"--stop-seconds", &times.stop_seconds, 0.0},
      {"--damp-seconds", &times.damp_seconds, 0.1},
      {"--damping-factor", &times.damping_factor, 0.1},
  };
}

}  // namespace ksim
