// Part 3: the cost s(r) of the constraint rows, their forces -ds/dr and stiffnesses d2s/dr2 (computation chapter,
// "Constraint model" and "Friction cones"; engine_core_constraint.c, mj_constraintUpdate_impl).
//
//   equality        1/2 D r^2
//   limit, contact  1/2 D r^2 for r < 0, else 0: one-sided
//   dry friction    1/2 D r^2 for |r| < R f with R = 1 / D and the bound f, else f (|r| - R f / 2)
//   elliptic cone   with mu = friction[0] / sqrt(impratio), N = mu r[0], T = |(friction[i] r[i])|:
//                   0 for N >= mu T; sum of 1/2 D[i] r[i]^2 for mu N + T <= 0;
//                   else 1/2 Dm (N - mu T)^2 with Dm = D[0] / (mu^2 (1 + mu^2))
#pragma once
#include "ksim_rl/physics/newton/layout.cuh"

namespace newton {

CUDA_CALLABLE inline int cone_zone(float normal, float tangent, float mu)
{
    return normal >= mu * tangent ? SATISFIED : mu * normal + tangent <= 0.0f ? QUADRATIC : CURVED;
}

CUDA_CALLABLE inline float cone_Dm(const Solve& s, int head)
{
    const float mu = s.bound[head];
    return ratio(s.efc_D[head], mu * mu * (1.0f + mu * mu));
}

// What a row costs where at(row) is its residual; the head of a cone stands for all of it.
template <class At>
CUDA_CALLABLE inline float cost_of(const Solve& s, int row, At at)
{
    const int kind = s.kind_of(row);
    const float here = at(row), quadratic = 0.5f * s.efc_D[row] * here * here;
    if (kind == CONE_TANGENT || (kind == ONE_SIDED && here >= 0.0f))
        return 0.0f;
    if (kind == FRICTION) {
        const float reach = ratio(s.bound[row], s.efc_D[row]);
        return fabsf(here) < reach ? quadratic : s.bound[row] * (fabsf(here) - 0.5f * reach);
    }
    if (!ELLIPTIC || kind != CONE_HEAD)
        return quadratic;
    float tangent2 = 0.0f, of_all = quadratic;
#pragma unroll 1
    for (int mate = row + 1; mate < row + s.cone_size(row); ++mate) {
        tangent2 += at(mate) * s.bound[mate] * at(mate) * s.bound[mate];
        of_all += 0.5f * s.efc_D[mate] * at(mate) * at(mate);
    }
    const float mu = s.bound[row], tangent = sqrtf(tangent2), gap = here * mu - mu * tangent;
    const int state = cone_zone(here * mu, tangent, mu);
    return state == SATISFIED ? 0.0f : state == QUADRATIC ? of_all : 0.5f * cone_Dm(s, row) * gap * gap;
}

// Sets the force, the stiffness and the state of a row; each row of a cone looks at all of them. In the curved zone,
// where the Hessian is no diagonal, the head has -Dm in the place of its stiffness, and `cones` has the spring
// force[0] / T that the tangents share (part 6).
CUDA_CALLABLE inline void update_row(const Solve& s, int row)
{
    const int kind = s.kind_of(row);
    int state = QUADRATIC;
    float curvature = s.efc_D[row], push = -s.efc_D[row] * s.residual[row];
    if (kind == ONE_SIDED && s.residual[row] >= 0.0f) {
        state = SATISFIED;
        push = curvature = 0.0f;
    } else if (kind == FRICTION) {
        const float most = s.bound[row], reach = ratio(most, s.efc_D[row]);
        state = s.residual[row] <= -reach ? LINEAR_NEGATIVE : s.residual[row] >= reach ? LINEAR_POSITIVE : QUADRATIC;
        push = state == LINEAR_NEGATIVE ? most : state == LINEAR_POSITIVE ? -most : push;
        curvature = state == QUADRATIC ? curvature : 0.0f;
    }
    if (ELLIPTIC && kind >= CONE_HEAD) {
        const int head = s.head_of(row), size = s.cone_size(row);
        const float mu = s.bound[head], normal = s.residual[head] * mu;
        float tangent2 = 0.0f;
UNROLL
        for (int mate = 1; mate < MOST_OF_CONE; ++mate)
            if (mate < size) {
                const float slip = s.residual[head + mate] * s.bound[head + mate];
                tangent2 += slip * slip;
            }
        const float tangent = sqrtf(tangent2);
        state = cone_zone(normal, tangent, mu);
        const float Dm = cone_Dm(s, head), of_head = Dm * (mu * tangent - normal) * mu;
        const float spring = state == CURVED ? of_head / tangent : 0.0f;
        if (state == SATISFIED)
            push = curvature = 0.0f;
        if (state == CURVED) {
            curvature = kind == CONE_HEAD ? -Dm : spring * s.bound[row] * s.bound[row];
            push = kind == CONE_HEAD ? of_head : -curvature * s.residual[row];
        }
        if (kind == CONE_HEAD)
            s.cones[4 * row] = spring;
        float pull2 = 0.0f;
        for (int mate = head + 1; CHECKED && mate < head + size; ++mate) {
            const float each = state == QUADRATIC ? s.efc_D[mate] / s.bound[mate] : spring * s.bound[mate];
            pull2 += each * each * s.residual[mate] * s.residual[mate];
        }
        const float most = state == SATISFIED ? 0.0f : state == CURVED ? of_head : -s.efc_D[head] * s.residual[head];
        s.require(state == SATISFIED || sqrtf(pull2) <= most * (1.0f + 1e-3f), FORCES_ARE_ADMISSIBLE);
    }
    s.require(
        kind == EQUALITY || kind == CONE_TANGENT || (kind == FRICTION ? fabsf(push) <= s.bound[row] : push >= 0.0f),
        FORCES_ARE_ADMISSIBLE
    );
    s.force[row] = push;
    s.stiffness[row] = curvature;
    s.states[row] = state;
}

}
