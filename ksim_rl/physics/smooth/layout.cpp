// Part 2: where the numbers of a world lie on the chip, from where they go to global memory in whole rows: lanes that
// write the fields of a body each on their own would touch every sector of memory once per number.
//
// Spatial vectors (`spatial`) have their rotation first. Those of a world, and its inertias, are at the centre of mass
// of the kinematic tree they belong to, with the axes of the world (computation chapter, "Kinematic tree").

using spatial = wp::vec_t<6, float>;
using inertia10 = wp::vec_t<10, float>;

constexpr int UNROLLED_BODIES = NUM_BODIES <= 64 ? NUM_BODIES : 4;
constexpr int POSE = 10;  // floats of a body: position, quaternion and centre of mass, then its inertia

float* const poses = chip;
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
