// Spatial vectors, which have their rotation first, and inertias: of a world these are at the centre of mass of the
// kinematic tree that they belong to, with the axes of the world (computation chapter, "Kinematic tree").
#pragma once
#include "ksim_rl/physics/smooth/quaternions.cuh"

namespace smooth {

using spatial = wp::vec_t<6, float>;
using inertia10 = wp::vec_t<10, float>;  // xx yy zz xy xz yz, then mass times offset, then mass

CUDA_CALLABLE inline spatial spatial_of(const vec3& rotation, const vec3& translation)
{
    spatial both;
    for (int i = 0; i < 3; ++i) {
        both[i] = rotation[i];
        both[3 + i] = translation[i];
    }
    return both;
}

CUDA_CALLABLE inline vec3 rotation_of(const spatial& v)
{
    return vec3(v[0], v[1], v[2]);
}

CUDA_CALLABLE inline vec3 translation_of(const spatial& v)
{
    return vec3(v[3], v[4], v[5]);
}

// The rate of a motion that a velocity carries along.
CUDA_CALLABLE inline spatial cross_motion(const spatial& v, const spatial& m)
{
    const vec3 w = rotation_of(v);
    return spatial_of(
        wp::cross(w, rotation_of(m)),
        wp::cross(translation_of(v), rotation_of(m)) + wp::cross(w, translation_of(m))
    );
}

CUDA_CALLABLE inline spatial cross_force(const spatial& v, const spatial& f)
{
    const vec3 w = rotation_of(v);
    return spatial_of(
        wp::cross(w, rotation_of(f)) + wp::cross(translation_of(v), translation_of(f)),
        wp::cross(w, translation_of(f))
    );
}

CUDA_CALLABLE inline spatial times_inertia(const inertia10& i, const spatial& v)
{
    const vec3 w = rotation_of(v), u = translation_of(v), offset(i[6], i[7], i[8]);
    const vec3 turned(
        i[0] * w[0] + i[3] * w[1] + i[4] * w[2], i[3] * w[0] + i[1] * w[1] + i[5] * w[2],
        i[4] * w[0] + i[5] * w[1] + i[2] * w[2]
    );
    return spatial_of(turned + wp::cross(offset, u), i[9] * u - wp::cross(offset, w));
}

}
