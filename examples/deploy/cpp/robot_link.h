// What passes between a loop and a robot: measurements one way, commands of joints the other.
#pragma once

#include <array>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>

#include "text.h"

namespace ksim {

// What a robot measured at one moment; numbers of joints stand in the order of joints.names in export.json.
struct Measurement {
  double stamp = 0.0;                       // when it arrived, s of the loop's clock
  Numbers joint_pos;                        // rad, or m for slides
  Numbers joint_vel;                        // per second
  Numbers joint_effort;                     // N m, or N
  std::optional<Numbers> root_quat;         // attitude (w, x, y, z); none of a robot that is fixed to the world
  std::optional<Numbers> root_ang_vel;      // rad/s, in the root's own axes
  std::optional<long long> count;           // the robot's own number of this state, if it has one
  std::map<std::string, Numbers> estimates;  // what else obs.onnx reads, by the names of its inputs
};

// What motors are asked for: a motor exerts effort + stiffness * (pos - measured) + damping * (vel - measured).
struct JointCommand {
  Numbers pos;
  Numbers vel;
  Numbers effort;
  Numbers stiffness;
  Numbers damping;
};

// A robot of yours. None of these may wait for it.
class Robot {
 public:
  virtual ~Robot() = default;
  // The newest measurement; none before the first.
  virtual std::optional<Measurement> read() = 0;
  virtual void write(const JointCommand& command) = 0;
};

// Why motors are damped from now on, in one line.
struct Fault : std::runtime_error {
  using std::runtime_error::runtime_error;
};

using Vector3 = std::array<double, 3>;
inline constexpr Vector3 down = {0.0, 0.0, -1.0};  // gravity's direction in the world

inline Vector3 cross(const Vector3& a, const Vector3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// Returns a vector of a root's axes in the axes of the world; `quat` has the length 1.
inline Vector3 to_world_axes(const Numbers& quat, const Vector3& vector) {
  const Vector3 axis = {quat[1], quat[2], quat[3]};
  Vector3 twice = cross(axis, vector);
  for (double& value : twice) value *= 2.0;
  const Vector3 across = cross(axis, twice);
  Vector3 turned;
  for (size_t k = 0; k < 3; ++k) turned[k] = vector[k] + quat[0] * twice[k] + across[k];
  return turned;
}

// Returns a vector of the world in the axes of a root.
inline Vector3 to_root_axes(const Numbers& quat, const Vector3& vector) {
  return to_world_axes({quat[0], -quat[1], -quat[2], -quat[3]}, vector);
}

}  // namespace ksim
