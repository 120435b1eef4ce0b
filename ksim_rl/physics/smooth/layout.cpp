// Part 1: where the numbers of a world lie, and how its lanes share the work.
//
// These parts are the body of the function smooth_dynamics(world, lane, forces_too, problem), before which kernel.py puts the
// constants of the kernel: the sizes of the model and what it has of MuJoCo's features. They follow MuJoCo's chapter on
// computation (https://mujoco.readthedocs.io/en/stable/computation/index.html) and engine_core_smooth.c, stage by
// stage, and add in one order whatever the number of lanes.
//
// The lanes of a world, some of the threads of a warp, share out its bodies, joints, degrees of freedom or chains from
// a root to a leaf. What another lane reads next lies on the chip, and goes to global memory in whole rows: lanes that
// write the fields of a body each on their own would touch every sector of memory once per number.
//
// Spatial vectors (`spatial`) have their rotation first. Those of a world, and its inertias, are at the centre of mass
// of the kinematic tree they belong to, with the axes of the world (computation chapter, "Kinematic tree").

using vec3 = wp::vec3;
using quat = wp::quat;
using mat33 = wp::mat33;
using spatial = wp::vec_t<6, float>;
using inertia10 = wp::vec_t<10, float>;

constexpr float TINY = 1e-15f, PI = 3.14159265f;
constexpr int UNROLLED_BODIES = NUM_BODIES <= 64 ? NUM_BODIES : 4;
constexpr int POSE = 10;  // floats of a body: position, quaternion and centre of mass, then its inertia

#if defined(__CUDA_ARCH__)
__shared__ __align__(16) float memory[FLOATS * (THREADS / LANES)];
float* const poses = memory + (threadIdx.x / LANES) * FLOATS;
#else
static float memory[FLOATS];
float* const poses = memory;
#endif
float* const inertias = poses;  // once the poses are written
float* const sums = poses;  // forces of the actuators and passive forces, once the inertias are summed
float* const coms = poses + POSES;  // centres of mass of subtrees
float* const joints = coms + 3 * NUM_BODIES;  // anchors and axes
float* const velocities = joints;  // of the bodies, once the degrees of freedom have their axes
float* const momenta = joints;  // crb * cdof, once the bodies have their forces
float* const motions = joints + JOINTS;  // cdof
float* const forces = motions + 6 * NUM_DOFS;  // accelerations of the bodies under their velocities, then forces
float* const staged = motions;  // until then, what waits to be written
constexpr int STAGED = 6 * (NUM_DOFS + NUM_BODIES);

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
// Writes the vectors that lie on the chip, `stride` floats from one to the next, as the first `count` of a row.
auto write = [&](auto& array, int count, const float* from, int stride) {
    constexpr int WIDTH = sizeof(*array.data) / sizeof(float);
    float* const to = (float*)row_of(array);
#pragma unroll 4
    for (int place = lane; place < count * WIDTH; place += LANES)
        to[place] = from[place / WIDTH * stride + place % WIDTH];
};
// Writes compute(item) at place_of(item) of a row, for all items.
auto compute_row = [&](auto& array, int count, auto place_of, auto compute) {
    using Value = decltype(compute(0));
    constexpr int WIDTH = sizeof(Value) / sizeof(float), ROOM = STAGED / WIDTH;
    float* const to = (float*)row_of(array);
#pragma unroll 1
    for (int first = 0; first < count; first += ROOM) {
        const int items = wp::min(ROOM, count - first);
        each(items, [&](int item) { ((Value*)staged)[item] = compute(first + item); });
        sync();
#pragma unroll 4
        for (int place = lane; place < items * WIDTH; place += LANES)
            to[place_of(first + place / WIDTH) * WIDTH + place % WIDTH] = staged[place];
        sync();
    }
};
auto itself = [](int item) { return item; };
// What lies on the chip.
auto position = [&](int body) -> vec3& { return *(vec3*)(poses + POSE * body); };
auto turn = [&](int body) -> quat& { return *(quat*)(poses + POSE * body + 3); };
auto center = [&](int body) -> vec3& { return *(vec3*)(poses + POSE * body + 7); };
auto inertia = [&](int body) -> inertia10& { return *(inertia10*)(inertias + POSE * body); };
auto com = [&](int body) -> vec3& { return *(vec3*)(coms + 3 * body); };
auto anchor = [&](int joint) -> vec3& { return *(vec3*)(joints + 6 * joint); };
auto axis = [&](int joint) -> vec3& { return *(vec3*)(joints + 6 * joint + 3); };
auto motion = [&](int dof) -> spatial& { return *(spatial*)(motions + 6 * dof); };
auto velocity = [&](int body) -> spatial& { return *(spatial*)(velocities + 6 * body); };
auto momentum = [&](int dof) -> spatial& { return *(spatial*)(momenta + 6 * dof); };
auto force = [&](int body) -> spatial& { return *(spatial*)(forces + 6 * body); };

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
auto spatial_of = [](const vec3& rotation, const vec3& translation) {
    spatial both;
    for (int i = 0; i < 3; ++i) {
        both[i] = rotation[i];
        both[3 + i] = translation[i];
    }
    return both;
};
auto rotation_of = [](const spatial& v) { return vec3(v[0], v[1], v[2]); };
auto translation_of = [](const spatial& v) { return vec3(v[3], v[4], v[5]); };
// The rate of a motion that a velocity carries along.
auto cross_motion = [=](const spatial& v, const spatial& m) {
    const vec3 w = rotation_of(v);
    return spatial_of(
        wp::cross(w, rotation_of(m)),
        wp::cross(translation_of(v), rotation_of(m)) + wp::cross(w, translation_of(m))
    );
};
auto cross_force = [=](const spatial& v, const spatial& f) {
    const vec3 w = rotation_of(v);
    return spatial_of(
        wp::cross(w, rotation_of(f)) + wp::cross(translation_of(v), translation_of(f)),
        wp::cross(w, translation_of(f))
    );
};
// Inertia: xx yy zz xy xz yz, then mass times offset, then mass.
auto times_inertia = [=](const inertia10& i, const spatial& v) {
    const vec3 w = rotation_of(v), u = translation_of(v), offset(i[6], i[7], i[8]);
    const vec3 turned(
        i[0] * w[0] + i[3] * w[1] + i[4] * w[2], i[3] * w[0] + i[1] * w[1] + i[5] * w[2],
        i[4] * w[0] + i[5] * w[1] + i[2] * w[2]
    );
    return spatial_of(turned + wp::cross(offset, u), i[9] * u - wp::cross(offset, w));
};
