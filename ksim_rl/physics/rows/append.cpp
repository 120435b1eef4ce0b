// The first half of the lists where MuJoCo Warp's narrow phase has a part: all threads share out the pool.

const int worlds = problem.appended.shape[0], room = problem.found.shape[1];
#pragma unroll 1
for (int contact = world * LANES + lane; contact < wp::min(*problem.nacon.data, problem.naconmax);
     contact += worlds * LANES) {
    if (!(problem.contact_type.data[contact] & HAS_ROWS))
        continue;
    const int owner = problem.contact_worldid.data[contact];
    const int place = wp::atomic_add(problem.appended.data + owner, 1);
    if (place < room)
        problem.found.data[owner * room + place] = contact;
}
