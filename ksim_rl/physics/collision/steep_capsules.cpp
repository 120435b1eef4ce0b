// Lets the first tangent of MuJoCo Warp's contacts of plane and capsule follow the capsule, however steep it stands. All
// threads share out the pool.

constexpr float UPRIGHT = 1e-6f;  // rad, below which the direction of a capsule is rounding
#pragma unroll 1
for (int contact = world * LANES + lane; contact < wp::min(*problem.nacon.data, problem.naconmax);
     contact += problem.geom_xmat.shape[0] * LANES) {
    const int plane = problem.contact_geom.data[contact][0], capsule = problem.contact_geom.data[contact][1];
    if (plane < 0 || capsule < 0 || problem.geom_type.data[plane] != PLANE || problem.geom_type.data[capsule] != CAPSULE)
        continue;
    const int place = problem.contact_worldid.data[contact] * problem.geom_xmat.shape[1] + capsule;
    const wp::mat33 turn = problem.geom_xmat.data[place];
    wp::mat33& frame = problem.contact_frame.data[contact];
    const wp::vec3 axis(turn.data[0][2], turn.data[1][2], turn.data[2][2]);
    const wp::vec3 normal(frame.data[0][0], frame.data[0][1], frame.data[0][2]);
    wp::vec3 tangent = axis - normal * wp::dot(axis, normal);
    const float length = wp::length(tangent);
    // MuJoCo Warp does so itself from a length of 0.5 on.
    if (length >= 0.5f || length <= UPRIGHT)
        continue;
    tangent = tangent / length;
    const wp::vec3 last = wp::cross(normal, tangent);
    for (int i = 0; i < 3; ++i) {
        frame.data[1][i] = tangent[i];
        frame.data[2][i] = last[i];
    }
}
