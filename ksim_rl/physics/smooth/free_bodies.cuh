// Part 3 of the integration: with implicitfast a body that has nothing but a free joint is solved for with the
// derivative of its gyroscopic forces too (mjd_freeMhat), which is not symmetric. With w its angular velocity and s the
// arm from its frame to its centre of mass, both along the axes of the world, m its mass and I its inertia there,
//
//     d bias / d v = [0  -m K R; 0  R' (-m [s] K + [w] I - [I w]) R],   K = s w' - w's + [w x s].
//
// The pose is read from qpos: xpos and xmat are written only in substeps whose results are read.
#pragma once
#include "ksim_rl/physics/smooth/factorization.cuh"

namespace integration {

CUDA_CALLABLE inline void solve_free_bodies(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float timestep = world.of_world(a.timestep);
    world.each(NUM_FREE_BODIES, [&](int free) {
        const int body = look_up(a.body_freeadr, free), first = look_up(a.body_dofadr, body);
        const auto& crb = world.row_of(a.crb)[body];
        const float mass = crb[9];
        const float* const q = world.row_of(a.qpos) + look_up(a.jnt_qposadr, look_up(a.body_jntadr, body));
        const mat33 turn = matrix(unit_quat(q + 3));
        const mat33 moments(crb[0], crb[3], crb[4], crb[3], crb[1], crb[5], crb[4], crb[5], crb[2]);
        const vec3 arm = world.row_of(a.subtree_com)[body] - vec3(q[0], q[1], q[2]);
        const float* const own_spin = world.row_of(a.qvel) + first + 3;
        const vec3 spin = wp::mul(turn, vec3(own_spin[0], own_spin[1], own_spin[2]));
        mat33 K = wp::outer(arm, spin) + wp::skew(wp::cross(spin, arm));
        for (int i = 0; i < 3; ++i)
            K.data[i][i] -= wp::dot(spin, arm);
        const mat33 of_translation = -mass * wp::mul(K, turn);
        const mat33 turning = wp::mul(wp::skew(spin), moments) - wp::skew(wp::mul(moments, spin));
        const mat33 of_rotation
            = wp::mul(wp::transpose(turn), wp::mul(turning - mass * wp::mul(wp::skew(arm), K), turn));

        float block[6][7] = {};
        for (int i = 0; i < 6; ++i) {
            const int start = row_start(a, first + i), ancestors = num_ancestors(a, first + i);
            for (int place = 0; place <= ancestors; ++place) {
                const int j = look_up(a.M_colind, start + place) - first;
                block[i][j] = block[j][i] = shared.system[start + place];
            }
            block[i][6] = shared.right[first + i];
        }
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 3; ++j)
                block[i][3 + j] += timestep * (i < 3 ? of_translation.data[i][j] : of_rotation.data[i - 3][j]);
        for (int column = 0; column < 6; ++column) {
            int largest = column;
            for (int i = column + 1; i < 6; ++i)
                if (wp::abs(block[i][column]) > wp::abs(block[largest][column]))
                    largest = i;
            for (int j = column; j < 7; ++j) {
                const float kept = block[column][j];
                block[column][j] = block[largest][j];
                block[largest][j] = kept;
            }
            for (int i = column + 1; i < 6; ++i) {
                const float factor = block[i][column] / block[column][column];
                for (int j = column + 1; j < 7; ++j)
                    block[i][j] -= factor * block[column][j];
            }
        }
        for (int i = 5; i >= 0; --i) {
            float sum = block[i][6];
            for (int j = i + 1; j < 6; ++j)
                sum -= block[i][j] * shared.qacc[first + j];
            shared.qacc[first + i] = sum / block[i][i];
        }
    });
    sync_warp();
}

}
