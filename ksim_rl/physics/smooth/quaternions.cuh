// Rotations by quaternions, w x y z.
#pragma once
#include "builtin.h"

namespace smooth {

using vec3 = wp::vec3;
using quat = wp::quat;
using mat33 = wp::mat33;

constexpr float TINY = 1e-15f, PI = 3.14159265f;

CUDA_CALLABLE inline quat product(const quat& u, const quat& v)
{
    return quat(
        u.x * v.x - u.y * v.y - u.z * v.z - u.w * v.w, u.x * v.y + u.y * v.x + u.z * v.w - u.w * v.z,
        u.x * v.z - u.y * v.w + u.z * v.x + u.w * v.y, u.x * v.w + u.y * v.z - u.z * v.y + u.w * v.x
    );
}

CUDA_CALLABLE inline vec3 rotate(const vec3& v, const quat& q)
{
    const vec3 u(q.y, q.z, q.w);
    return 2.0f * wp::dot(u, v) * u + (q.x * q.x - wp::dot(u, u)) * v + 2.0f * q.x * wp::cross(u, v);
}

CUDA_CALLABLE inline mat33 matrix(const quat& q)
{
    const float ww = q.x * q.x, wx = q.x * q.y, wy = q.x * q.z, wz = q.x * q.w, xx = q.y * q.y;
    const float xy = q.y * q.z, xz = q.y * q.w, yy = q.z * q.z, yz = q.z * q.w, zz = q.w * q.w;
    return mat33(
        ww + xx - yy - zz, 2.0f * (xy - wz), 2.0f * (xz + wy), 2.0f * (xy + wz), ww - xx + yy - zz, 2.0f * (yz - wx),
        2.0f * (xz - wy), 2.0f * (yz + wx), ww - xx - yy + zz
    );
}

CUDA_CALLABLE inline quat unit_quat(const float* q)
{
    return wp::normalize(quat(q[0], q[1], q[2], q[3]));
}

// The rotation vector of a unit quaternion, by at most half a turn.
CUDA_CALLABLE inline vec3 rotation_vector(const quat& q)
{
    const vec3 u(q.y, q.z, q.w);
    const float sine = wp::length(u);
    if (sine == 0.0f)
        return vec3();
    float angle = 2.0f * wp::atan2(sine, q.x);
    angle -= angle > PI ? 2.0f * PI : 0.0f;
    return u * (angle / sine);
}

}
