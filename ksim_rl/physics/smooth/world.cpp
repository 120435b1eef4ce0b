// Part 1 of both kernels: how the lanes of a world share its work, how they reach its numbers, and what they compute
// with.
//
// The parts of a kernel are the body of one function of (world, lane, problem), before which stages.py puts the
// constants of the kernel: the sizes of the model and what it has of MuJoCo's features. They follow MuJoCo's chapter on
// computation (https://mujoco.readthedocs.io/en/stable/computation/index.html) and engine_core_smooth.c, stage by
// stage, and add in one order whatever the number of lanes.
//
// The lanes of a world, some of the threads of a warp, share out its bodies, joints, degrees of freedom or chains from
// a root to a leaf. What another lane reads next lies on the chip.

using vec3 = wp::vec3;
using quat = wp::quat;
using mat33 = wp::mat33;

constexpr float TINY = 1e-15f, PI = 3.14159265f;

#if defined(__CUDA_ARCH__)
__shared__ __align__(16) float memory[FLOATS * (THREADS / LANES)];
float* const chip = memory + (threadIdx.x / LANES) * FLOATS;
#else
static float memory[FLOATS];
float* const chip = memory;
#endif

auto row_of = [=](auto& array) { return array.data + (size_t)world * array.shape[1]; };
// Of a field of the model, which has one row for each world or one for all.
auto model_row = [=](auto& array) { return array.data + (array.shape[0] > 1 ? (size_t)world * array.shape[1] : 0); };
auto of_world = [=](auto& array) { return array.data[array.shape[0] > 1 ? world : 0]; };
// Of a table that no kernel writes, so that it may be read ahead of what is written.
auto look_up = [](const auto& table, int item) {
#if defined(__CUDA_ARCH__)
    return __ldg(table.data + item);
#else
    return table.data[item];
#endif
};
auto sync = [] {
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
};
auto each = [&](int count, auto body) {
#pragma unroll 1
    for (int item = lane; item < count; item += LANES)
        body(item);
};
// Quaternions are w x y z.
auto product = [](const quat& u, const quat& v) {
    return quat(
        u.x * v.x - u.y * v.y - u.z * v.z - u.w * v.w, u.x * v.y + u.y * v.x + u.z * v.w - u.w * v.z,
        u.x * v.z - u.y * v.w + u.z * v.x + u.w * v.y, u.x * v.w + u.y * v.z - u.z * v.y + u.w * v.x
    );
};
auto rotate = [](const vec3& v, const quat& q) {
    const vec3 u(q.y, q.z, q.w);
    return 2.0f * wp::dot(u, v) * u + (q.x * q.x - wp::dot(u, u)) * v + 2.0f * q.x * wp::cross(u, v);
};
auto matrix = [](const quat& q) {
    const float ww = q.x * q.x, wx = q.x * q.y, wy = q.x * q.z, wz = q.x * q.w, xx = q.y * q.y;
    const float xy = q.y * q.z, xz = q.y * q.w, yy = q.z * q.z, yz = q.z * q.w, zz = q.w * q.w;
    return mat33(
        ww + xx - yy - zz, 2.0f * (xy - wz), 2.0f * (xz + wy), 2.0f * (xy + wz), ww - xx + yy - zz, 2.0f * (yz - wx),
        2.0f * (xz - wy), 2.0f * (yz + wx), ww - xx - yy + zz
    );
};
auto unit_quat = [](const float* q) { return wp::normalize(quat(q[0], q[1], q[2], q[3])); };
// The rotation vector of a unit quaternion, by at most half a turn.
auto rotation_vector = [](const quat& q) {
    const vec3 u(q.y, q.z, q.w);
    const float sine = wp::length(u);
    if (sine == 0.0f)
        return vec3();
    float angle = 2.0f * wp::atan2(sine, q.x);
    angle -= angle > PI ? 2.0f * PI : 0.0f;
    return u * (angle / sine);
};
// Calls body(actuator) for the actuators that add armature or damping to a joint: none, one, or (below -1) several.
auto each_actuator_of = [&](int joint, auto body) {
    const int only = look_up(problem.jnt_actuatorid, joint);
    if (only >= 0)
        body(only);
    for (int actuator = 0; only < -1 && actuator < NUM_ACTUATORS; ++actuator) {
        const int type = look_up(problem.actuator_trntype, actuator);
        if ((type == JOINT || type == JOINTINPARENT) && problem.actuator_trnid.data[actuator][0] == joint)
            body(actuator);
    }
};
// linear + poly[0] x + poly[1] x^2.
auto rate_at = [](float linear, const wp::vec2& poly, float x) {
    return linear + poly[0] * x + poly[1] * x * x;
};
struct Damping {
    float linear = 0.0f;
    wp::vec2 more;
};
// Of a degree of freedom, with what actuators add.
auto damping_of = [&](int joint, int dof) {
    Damping found;
    each_actuator_of(joint, [&](int actuator) {
        const float gear = model_row(problem.actuator_gear)[actuator][0];
        found.linear += model_row(problem.actuator_damping)[actuator] * gear * gear;
        found.more = found.more + model_row(problem.actuator_dampingpoly)[actuator] * gear * gear;
    });
    found.linear = model_row(problem.dof_damping)[dof] + found.linear;
    found.more = model_row(problem.dof_dampingpoly)[dof] + found.more;
    return found;
};
// Whether the option actuatorgroupdisable disables it (disabled_actuators.py).
auto is_switched_off = [&](int actuator) {
    return SOME_SWITCHED_OFF && look_up(problem.actuator_gaintype, actuator) == SWITCHED_OFF;
};
// The activation at the end of the substep.
auto next_activation = [&](int actuator, int address, float rate) {
    const float timestep = of_world(problem.timestep);
    const float own = row_of(problem.act)[address];
    float found = own + rate * timestep;
    if (look_up(problem.actuator_dyntype, actuator) == FILTEREXACT) {
        const float time_constant = wp::max(TINY, model_row(problem.actuator_dynprm)[actuator][0]);
        found = own + rate * time_constant * (1.0f - wp::exp(-timestep / time_constant));
    }
    const wp::vec2 range = model_row(problem.actuator_actrange)[actuator];
    return problem.actuator_actlimited.data[actuator] ? wp::clamp(found, range[0], range[1]) : found;
};
// Where its activation is, or -1.
auto activation_of = [&](int actuator) {
    const int first = HAS_ACTIVATION ? look_up(problem.actuator_actadr, actuator) : -1;
    return first < 0 ? -1 : first + look_up(problem.actuator_actnum, actuator) - 1;
};
auto ctrl_of = [&](int actuator) {
    if (look_up(problem.actuator_ctrlnum, actuator) == 0)
        return 0.0f;
    const int address = look_up(problem.actuator_ctrladr, actuator);
    const float found = row_of(problem.ctrl)[address];
    const wp::vec2 range = model_row(problem.actuator_ctrlrange)[address];
    return CLAMPS_CTRL && problem.actuator_ctrllimited.data[address] ? wp::clamp(found, range[0], range[1]) : found;
};
// What its gain multiplies: its activation, which changes at a rate, or its control where it has none.
auto input_of = [&](int actuator, float rate) {
    const int address = activation_of(actuator);
    if (address < 0)
        return ctrl_of(actuator);
    return problem.actuator_actearly.data[actuator] ? next_activation(actuator, address, rate)
                                                    : row_of(problem.act)[address];
};
