// What is compiled into the kernels of a model: its sizes, and what it has of MuJoCo's features.
#pragma once
#include "ksim_rl/device/lanes.cuh"
#include "ksim_rl/physics/smooth/quaternions.cuh"

namespace smooth {

namespace given {
// Types of joints, transmissions, dynamics, gains and biases.
constexpr int FREE = 0;
constexpr int BALL = 1;
constexpr int SLIDE = 2;
constexpr int HINGE = 3;
constexpr int JOINT = 0;
constexpr int JOINTINPARENT = 1;
constexpr int INTEGRATOR = 1;
constexpr int FILTER = 2;
constexpr int FILTEREXACT = 3;
constexpr int AFFINE_GAIN = 1;
constexpr int AFFINE_BIAS = 1;
constexpr int SWITCHED_OFF = -1;  // the gain of an actuator that an option disables
// Sizes.
constexpr int NUM_BODIES = 10;
constexpr int NUM_JOINTS = 8;
constexpr int NUM_DOFS = 14;
constexpr int NUM_CHAINS = 4;
constexpr int NUM_MOVING_GEOMS = 9;
constexpr int NUM_SITES = 2;
constexpr int NUM_ACTUATORS = 8;
constexpr int NUM_ENTRIES = 69;  // of the inertia matrix
constexpr int NUM_FREE_BODIES = 1;  // which are solved for on their own
constexpr int POSES = 100;  // floats of poses, then of inertias, then of sums of forces
constexpr int JOINTS = 84;  // floats of the joints' frames, then of velocities, then of momenta
constexpr int FLOATS = 368;  // that the lanes of a world share
// Features.
constexpr int HAS_MOCAP = 1;
constexpr int HAS_ACTIVATION = 1;
constexpr int GRAVITY = 1;
constexpr int LIFTS = 1;  // weights are compensated
constexpr int SPRINGS = 1;
constexpr int DAMPERS = 1;
constexpr int CLAMPS_CTRL = 1;
constexpr int ACTUATORS_ACT = 1;
constexpr int SOME_SWITCHED_OFF = 1;
constexpr int IMPLICIT_FAST = 1;
constexpr int SOLVES = 1;  // whether the integration solves for other accelerations
constexpr int PARENTS[] = {0, 0, 1, 2, 1, 4, 1, 6, 1, 8};  // of the bodies
}

using namespace given;
using namespace lanes;

}
