// Part 5: passive forces of springs and dampers (mj_passive).

float* const actuator_forces = sums;
float* const passive = sums + NUM_ACTUATORS;
// linear + poly[0] x + poly[1] x^2.
auto rate_at = [](float linear, const wp::vec2& poly, float x) {
    return linear + poly[0] * x + poly[1] * x * x;
};

each(NUM_JOINTS, [&](int joint) {
    const int type = look_up(problem.jnt_type, joint);
    const int dof = look_up(problem.jnt_dofadr, joint), dofs = type == FREE ? 6 : type == BALL ? 3 : 1;
    float spring[6] = {};
    const float stiffness = model_row(problem.jnt_stiffness)[joint];
    const wp::vec2 more_stiffness = model_row(problem.jnt_stiffnesspoly)[joint];
    if (SPRINGS && (stiffness != 0.0f || more_stiffness[0] != 0.0f || more_stiffness[1] != 0.0f)) {
        const float* q = qpos + look_up(problem.jnt_qposadr, joint);
        const float* rest = model_row(problem.qpos_spring) + look_up(problem.jnt_qposadr, joint);
        auto pull = [&](float* to, const vec3& away) {
            const float rate = rate_at(stiffness, more_stiffness, wp::length(away));
            for (int i = 0; i < 3; ++i)
                to[i] = -rate * away[i];
        };
        if (type == FREE) {
            pull(spring, vec3(q[0] - rest[0], q[1] - rest[1], q[2] - rest[2]));
            q += 3;
            rest += 3;
        }
        if (type == FREE || type == BALL) {
            const quat back(rest[0], -rest[1], -rest[2], -rest[3]);
            pull(spring + (dofs - 3), rotation_vector(product(back, unit_quat(q))));
        } else
            spring[0] = (rest[0] - q[0]) * rate_at(stiffness, more_stiffness, q[0] - rest[0]);
    }
    float damping_of_actuators = 0.0f;
    wp::vec2 more_of_actuators;
    if (DAMPERS)
        each_actuator_of(joint, [&](int actuator) {
            const float gear = model_row(problem.actuator_gear)[actuator][0];
            damping_of_actuators += model_row(problem.actuator_damping)[actuator] * gear * gear;
            more_of_actuators = more_of_actuators + model_row(problem.actuator_dampingpoly)[actuator] * (gear * gear);
        });
    for (int i = 0; i < dofs; ++i) {
        const float damping = model_row(problem.dof_damping)[dof + i] + damping_of_actuators;
        const wp::vec2 more = model_row(problem.dof_dampingpoly)[dof + i] + more_of_actuators;
        const bool damps = DAMPERS && (damping != 0.0f || more[0] != 0.0f || more[1] != 0.0f);
        const float speed = qvel[dof + i];
        const float damper = damps ? -speed * rate_at(damping, more, wp::abs(speed)) : 0.0f;
        row_of(problem.qfrc_spring)[dof + i] = spring[i];
        row_of(problem.qfrc_damper)[dof + i] = damper;
        row_of(problem.qfrc_passive)[dof + i] = passive[dof + i] = spring[i] + damper;
    }
});
