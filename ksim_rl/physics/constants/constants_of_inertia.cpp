// What follows from the joint-space inertia M at `qpos0` in one world: inverse weights, and accelerations of actuators.
//
// This is the body of the function constants_of_inertia(world, lane, c), before which constant_kernels.py puts the
// constants NV, NB, LANES, ON_CHIP and FLOATS. M = L^T D L is eliminated from the leaves to the root (Featherstone, "Rigid
// Body Dynamics Algorithms", 2008, section 6.5), which leaves L^-1 above the diagonal (transposed), and D on it. Then
// J M^-1 J^T = sum_k (J L^-1)_k^2 / D_k for each Jacobian row, sums of squares that nothing cancels in.
//
// Few worlds reset at a time, so that what counts is how long one takes: its lanes, a block on a GPU, share each stage,
// and what they work on lies on the chip where it fits. All of them reach each `sync`.

using vec3 = wp::vec3;
using mat33 = wp::mat33;

constexpr int WIDTH = NV > 0 ? NV : 1;
constexpr int COLUMNS = LANES < 32 ? LANES : 32, ROWS = LANES / COLUMNS;

float* factor = c.scratch.data + (size_t)world * FLOATS;
#if defined(__CUDA_ARCH__)
__shared__ float on_chip[ON_CHIP ? FLOATS : 1];
factor = ON_CHIP ? on_chip : factor;
#endif
float* const inverse = factor + NV * NV;  // of M
vec3* const axes = (vec3*)(inverse + NV * NV);
vec3* const anchors = axes + NV;
float* const rotates = (float*)(anchors + NV);
float* const reciprocals = rotates + NV;  // of D
int* const parents = (int*)(reciprocals + NV);
vec3* const points = (vec3*)(parents + NV);  // centres of mass
vec3* const moments = points + NB;  // mass of a subtree times its offset from the centre of mass of its first body
mat33* const inertias = (mat33*)(moments + NB);
mat33* const spreads = inertias + NB;  // inertia of a subtree about the centre of mass of its first body
float* const masses = (float*)(spreads + NB);
float* const totals = masses + NB;  // mass of a subtree
int* const tips = (int*)(totals + NB);  // the last dof that moves a body

auto sync = [] {
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
};
auto each = [&](int count, auto work) {
    for (int item = lane; item < count; item += LANES)
        work(item);
};
// Of a field that has one row for each world or one for all.
auto row_of = [=](auto& array) { return array.data + (array.shape[0] > 1 ? (size_t)world * array.shape[1] : 0); };
// Velocity of a point when its dof moves at unit speed.
auto velocity_of = [=](int dof, const vec3& point) {
    return rotates[dof] * wp::cross(axes[dof], point - anchors[dof]) + (1.0f - rotates[dof]) * axes[dof];
};

each(NV, [&](int dof) {
    axes[dof] = row_of(c.axis)[dof];
    anchors[dof] = row_of(c.anchor)[dof];
    rotates[dof] = c.dof_rotates.data[dof];
    parents[dof] = c.dof_parentid.data[dof];
});
each(NB, [&](int body) {
    points[body] = row_of(c.xipos)[body];
    inertias[body] = row_of(c.inertia)[body];
    masses[body] = row_of(c.body_mass)[body];
    tips[body] = c.last_dof.data[body];
});
each(NV * NV, [&](int place) { factor[place] = 0.0f; });
sync();

each(NB - 1, [&](int item) {
    const int first = item + 1, end = first + c.body_subtreenum.data[first];
    const vec3 point = points[first];
    float total = 0.0f;
    vec3 moment;
    mat33 spread;
    for (int body = first; body < end; ++body) {
        const vec3 offset = points[body] - point, part = masses[body] * offset;
        const float square = wp::dot(offset, part);
        total += masses[body];
        moment = moment + part;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                spread.data[i][j] += inertias[body].data[i][j] - offset[i] * part[j] + (i == j ? square : 0.0f);
    }
    totals[first] = total;
    moments[first] = moment;
    spreads[first] = spread;
});
sync();

// A row of M is what the momentum of a dof's subtree, moved at unit speed, is along the dofs of its chain.
each(NV, [&](int dof) {
    const int first = c.dof_bodyid.data[dof];
    const vec3 point = points[first], turning = rotates[dof] * axes[dof], velocity = velocity_of(dof, point);
    const vec3 momentum = totals[first] * velocity + wp::cross(turning, moments[first]);
    const vec3 spin = wp::mul(spreads[first], turning) + wp::cross(moments[first], velocity);
    float armature = row_of(c.dof_armature)[dof];
    for (int i = 0; i < c.num_actuators; ++i)
        if (c.actuator_dof.data[i] == dof) {
            const float gear = row_of(c.actuator_gear)[i][0];
            armature += row_of(c.actuator_armature)[i] * gear * gear;
        }
    for (int other = dof; other >= 0; other = parents[other]) {
        const float along = wp::dot(momentum, velocity_of(other, point)) + rotates[other] * wp::dot(spin, axes[other]);
        factor[dof * NV + other] = factor[other * NV + dof] = along + (other == dof ? armature : 0.0f);
    }
});
sync();

// Step k changes the rows above row k, of which each lane has some columns, and reads row k alone beside them.
for (int k = NV - 1; k >= 0; --k) {
    const float* __restrict__ const pivot = factor + k * NV;
    const float reciprocal = 1.0f / pivot[k];
    if (lane == 0)
        reciprocals[k] = reciprocal;
    for (int j = lane % COLUMNS; j < NV; j += COLUMNS) {
        const float scaled = (j == k ? 1.0f : pivot[j]) * reciprocal;
        if (scaled == 0.0f)
            continue;
#pragma unroll 4
        for (int i = lane / COLUMNS; i < k; i += ROWS)
            factor[i * NV + j] = (j == k ? 0.0f : factor[i * NV + j]) - pivot[i] * scaled;
    }
    sync();
}
auto share_of = [=](int k, int dof) { return dof == k ? 1.0f : factor[k * NV + dof]; };

each(NV * NV, [&](int place) {
    const int i = place / WIDTH, j = place % WIDTH, last = wp::min(i, j);
    float total = 0.0f;
    for (int k = last; k >= 0; k = parents[k])
        total += share_of(k, i) * share_of(k, j) * reciprocals[k];
    inverse[place] = total;
});
// Mean diagonal of J M^-1 J^T at each centre of mass: translation, rotation. As in C, a body that only slides has 0 for
// rotation, where mujoco_warp.set_const takes the other figure; and one that C calls simple, which slides along axes of
// the world and carries nothing, weighs what its mass does, whatever its armature.
each(NB, [&](int body) {
    if (c.slides_alone.data[body]) {
        row_of(c.body_invweight0)[body] = wp::vec2(1.0f / masses[body], 0.0f);
        return;
    }
    const vec3 point = points[body];
    float moved = 0.0f, turned = 0.0f;
    for (int k = tips[body]; k >= 0; k = parents[k]) {
        vec3 linear, angular;
        for (int i = tips[body]; i >= k; i = parents[i]) {
            const float share = share_of(k, i);
            linear = linear + share * velocity_of(i, point);
            angular = angular + share * rotates[i] * axes[i];
        }
        moved += wp::dot(linear, linear) * reciprocals[k];
        turned += wp::dot(angular, angular) * reciprocals[k];
    }
    row_of(c.body_invweight0)[body] = wp::vec2(moved / 3.0f, turned / 3.0f);
});
sync();

// Diagonal of M^-1, averaged over the translations and over the rotations of one joint.
each(NV, [&](int dof) {
    const int first = c.group_start.data[dof], size = c.group_size.data[dof];
    float total = 0.0f;
    for (int member = first; member < first + size; ++member)
        total += inverse[member * NV + member];
    const int body = c.dof_bodyid.data[dof];
    row_of(c.dof_invweight0)[dof] = c.slides_alone.data[body] ? 1.0f / masses[body] : total / (float)size;
});
// Norm of the acceleration from unit force: of a column of M^-1, times the gear.
each(c.actuator_dof.shape[0], [&](int actuator) {
    const float* const column = inverse + c.actuator_dof.data[actuator] * NV;
    float total = 0.0f;
#pragma unroll 4
    for (int dof = 0; dof < NV; ++dof)
        total += column[dof] * column[dof];
    row_of(c.actuator_acc0)[actuator] = wp::abs(row_of(c.actuator_gear)[actuator][0]) * wp::sqrt(total);
});
