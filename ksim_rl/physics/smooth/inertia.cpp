// Part 4: centres of mass, the axes of the degrees of freedom, and inertias, all at them (mj_comPos).

const float* const mass = model_row(problem.body_mass);
struct Column {
    float* data;
    int stride;
};
// Adds to each body's parent, from the last body to the first, what lies on the chip; a lane has a column of it. The
// parents are constants, so that sums stay in registers.
auto sum_subtrees = [&](int columns, auto column_of) {
    each(columns, [&](int index) {
        const Column column = column_of(index);
#pragma unroll UNROLLED_BODIES
        for (int body = NUM_BODIES - 1; body > 0; --body)
            column.data[PARENTS[body] * column.stride] += column.data[body * column.stride];
    });
    sync();
};

each(NUM_BODIES, [&](int body) { com(body) = mass[body] * center(body); });
sync();
sum_subtrees(3, [&](int index) { return Column {coms + index, 3}; });
each(NUM_BODIES, [&](int body) {
    const float total = model_row(problem.body_subtreemass)[body];
    com(body) = total < TINY ? center(body) : com(body) / total;
});
sync();
write(problem.subtree_com, NUM_BODIES, coms, 3);

each(NUM_JOINTS, [&](int joint) {
    const int body = look_up(problem.jnt_bodyid, joint), type = look_up(problem.jnt_type, joint);
    int dof = look_up(problem.jnt_dofadr, joint);
    const vec3 offset = com(look_up(problem.body_rootid, body)) - anchor(joint);
    if (type == SLIDE)
        motion(dof) = spatial_of(vec3(), axis(joint));
    else if (type == HINGE)
        motion(dof) = spatial_of(axis(joint), wp::cross(axis(joint), offset));
    else {
        const mat33 frame = matrix(turn(body));
        for (int i = 0; i < (type == FREE ? 3 : 0); ++i, ++dof)
            motion(dof) = spatial_of(vec3(), vec3(i == 0 ? 1.0f : 0.0f, i == 1 ? 1.0f : 0.0f, i == 2 ? 1.0f : 0.0f));
        for (int i = 0; i < 3; ++i, ++dof) {
            const vec3 column(frame.data[0][i], frame.data[1][i], frame.data[2][i]);
            motion(dof) = spatial_of(column, wp::cross(column, offset));
        }
    }
});
sync();
write(problem.cdof, NUM_DOFS, motions, 6);

each(NUM_BODIES, [&](int body) {
    const mat33 frame = inertial_frame(body);
    const vec3 moments = model_row(problem.body_inertia)[body];
    const vec3 offset = center(body) - com(look_up(problem.body_rootid, body));
    auto turned = [&](int i, int j) {
        float sum = 0.0f;
        for (int k = 0; k < 3; ++k)
            sum += frame.data[i][k] * moments[k] * frame.data[j][k];
        return sum;
    };
    const vec3 moment = mass[body] * offset;
    inertia10 found;
    found[0] = turned(0, 0) + moment[1] * offset[1] + moment[2] * offset[2];
    found[1] = turned(1, 1) + moment[0] * offset[0] + moment[2] * offset[2];
    found[2] = turned(2, 2) + moment[0] * offset[0] + moment[1] * offset[1];
    found[3] = turned(0, 1) - moment[0] * offset[1];
    found[4] = turned(0, 2) - moment[0] * offset[2];
    found[5] = turned(1, 2) - moment[1] * offset[2];
    for (int i = 0; i < 3; ++i)
        found[6 + i] = moment[i];
    found[9] = mass[body];
    inertia(body) = found;
});
sync();
if (problem.is_read)
    write(problem.cinert, NUM_BODIES, inertias, POSE);
