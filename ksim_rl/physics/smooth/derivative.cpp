// Part 2 of the integration: the matrix and the right side of
//
//     (M - h dF/dv) qacc' = M qacc
//
// (computation chapter, "Numerical integration"), in which h is the timestep and F are those smooth forces that depend
// on velocity: of dampers, and of actuators if the integrator is implicitfast. These act on the degree of freedom that
// they are of, since actuators drive hinges and slides alone, so that dF/dv is diagonal. M qacc is the solver's: with a
// solver that has converged it is the sum of all forces.
//
// The matrix has the entries of M: a row has a degree of freedom's ancestors, from the root on, and then itself.

float* const system = chip;
float* const right = system + NUM_ENTRIES;  // M qacc, then D L qacc', and the new velocities
float* const qacc = right + NUM_DOFS;  // qacc'
const float timestep = of_world(problem.timestep);
auto row_start = [&](int dof) { return look_up(problem.M_rowadr, dof); };
auto num_ancestors = [&](int dof) { return look_up(problem.M_rownnz, dof) - 1; };

auto present_input = [&](int actuator) {
    const int address = activation_of(actuator);
    return input_of(actuator, address < 0 ? 0.0f : row_of(problem.act_dot)[address]);
};
// What velocity adds to the force of the actuators on a degree of freedom.
auto drive_rate = [&](int dof) {
    const int joint = look_up(problem.dof_jntid, dof);
    auto is_clamped = [](float force, const wp::vec2& range) { return force <= range[0] || force >= range[1]; };
    float sum = 0.0f;
    if (problem.jnt_actfrclimited.data[joint]
        && is_clamped(row_of(problem.qfrc_actuator)[dof], model_row(problem.jnt_actfrcrange)[joint]))
        return sum;
#pragma unroll 1
    for (int i = look_up(problem.first_driver, dof); i < look_up(problem.first_driver, dof + 1); ++i) {
        const int actuator = look_up(problem.drivers, i);
        if (is_switched_off(actuator))
            continue;
        if (problem.actuator_forcelimited.data[actuator]
            && is_clamped(row_of(problem.actuator_force)[actuator], model_row(problem.actuator_forcerange)[actuator]))
            continue;
        float rate = 0.0f;
        if (look_up(problem.actuator_biastype, actuator) == AFFINE_BIAS)
            rate = model_row(problem.actuator_biasprm)[actuator][2];
        if (look_up(problem.actuator_gaintype, actuator) == AFFINE_GAIN)
            rate += model_row(problem.actuator_gainprm)[actuator][2] * present_input(actuator);
        const float gear = model_row(problem.actuator_gear)[actuator][0];
        sum += gear * (gear * rate);  // a rate of 0 is none, however large the gear is
    }
    return sum;
};

if (SOLVES) {
#pragma unroll 4
    for (int entry = lane; entry < NUM_ENTRIES; entry += LANES)
        system[entry] = row_of(problem.M)[entry];
    sync();
    each(NUM_DOFS, [&](int dof) {
        float rate = 0.0f;
        if (DAMPERS) {
            const Damping damping = damping_of(look_up(problem.dof_jntid, dof), dof);
            const wp::vec2 more(2.0f * damping.more[0], 3.0f * damping.more[1]);
            rate = rate_at(damping.linear, more, wp::abs(row_of(problem.qvel)[dof]));
        }
        if (IMPLICIT_FAST)
            rate -= drive_rate(dof);
        system[row_start(dof) + num_ancestors(dof)] += timestep * rate;
        right[dof] = row_of(problem.efc_Ma)[dof];
    });
    sync();
}
