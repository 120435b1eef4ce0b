// Part 7: what actuators do (mj_transmission, mj_fwdActuation), and the sum of all forces but those of constraints
// (mj_fwdAcceleration). An actuator drives a hinge or a slide, and has a gain, a bias and an activation that are
// affine.

auto activation_rate = [&](int actuator, float ctrl, float act) {
    const int type = look_up(problem.actuator_dyntype, actuator);
    if (type == INTEGRATOR)
        return ctrl;
    if (type == FILTER || type == FILTEREXACT)
        return (ctrl - act) / wp::max(TINY, model_row(problem.actuator_dynprm)[actuator][0]);
    return 0.0f;
};

each(NUM_ACTUATORS, [&](int actuator) {
    const int joint = problem.actuator_trnid.data[actuator][0], dof = look_up(problem.jnt_dofadr, joint);
    const float gear = model_row(problem.actuator_gear)[actuator][0];
    const float length = qpos[look_up(problem.jnt_qposadr, joint)] * gear, speed = gear * qvel[dof];
    if (problem.is_read) {
        row_of(problem.actuator_length)[actuator] = length;
        // C does not compute it without actuation.
        row_of(problem.actuator_velocity)[actuator] = ACTUATORS_ACT ? speed : 0.0f;
        row_of(problem.moment_rownnz)[actuator] = 1;
        row_of(problem.moment_rowadr)[actuator] = actuator;
        row_of(problem.moment_colind)[actuator] = dof;
        row_of(problem.actuator_moment)[actuator] = gear;
    }
    float rate = 0.0f, found = 0.0f;
    const int address = activation_of(actuator);
    if (address >= 0) {
        if (ACTUATORS_ACT)
            rate = activation_rate(actuator, ctrl_of(actuator), row_of(problem.act)[address]);
        row_of(problem.act_dot)[address] = rate;
    }
    const float input = input_of(actuator, rate);
    if (ACTUATORS_ACT && !is_switched_off(actuator)) {
        auto affine = [&](const auto& factors) {
            return factors[0] + factors[1] * length + factors[2] * speed;
        };
        const auto gain = model_row(problem.actuator_gainprm)[actuator];
        const auto bias = model_row(problem.actuator_biasprm)[actuator];
        found = (look_up(problem.actuator_gaintype, actuator) == AFFINE_GAIN ? affine(gain) : gain[0]) * input;
        found += look_up(problem.actuator_biastype, actuator) == AFFINE_BIAS ? affine(bias) : 0.0f;
    }
    // C keeps what is switched off within a range, too, which need not have 0 in it.
    if (ACTUATORS_ACT && problem.actuator_forcelimited.data[actuator]) {
        const wp::vec2 range = model_row(problem.actuator_forcerange)[actuator];
        found = wp::clamp(found, range[0], range[1]);
    }
    row_of(problem.actuator_force)[actuator] = actuator_forces[actuator] = found;
});
// Forces that the user applies to bodies are rare: whether this lane sees one, and then whether any does.
bool sees_push = false;
#pragma unroll 8
for (int place = lane; place < 6 * NUM_BODIES; place += LANES)
    sees_push |= !(((const float*)row_of(problem.xfrc_applied))[place] == 0.0f);
sync();
#if defined(__CUDA_ARCH__)
const unsigned own_lanes = (LANES == 32 ? 0xffffffffu : (1u << LANES) - 1u) << (threadIdx.x % 32 / LANES * LANES);
const bool is_pushed = __ballot_sync(own_lanes, sees_push) != 0;
#else
const bool is_pushed = sees_push;
#endif
each(NUM_DOFS, [&](int dof) {
    const int joint = look_up(problem.dof_jntid, dof), body = look_up(problem.dof_bodyid, dof);
    const float bias = wp::dot(motion(dof), force(body));
    float driven = 0.0f;
#pragma unroll 1
    for (int i = look_up(problem.first_driver, dof); i < look_up(problem.first_driver, dof + 1); ++i) {
        const int actuator = look_up(problem.drivers, i);
        driven += model_row(problem.actuator_gear)[actuator][0] * actuator_forces[actuator];
    }
    if (LIFTS) {
        // Weights that are compensated (mj_gravcomp), by what is passive or by actuators.
        const vec3 spin = rotation_of(motion(dof)), origin = com(look_up(problem.body_rootid, body));
        float lifted = 0.0f;
#pragma unroll 1
        for (int of = body; of < body + look_up(problem.body_subtreenum, body); ++of) {
            const vec3 moved = translation_of(motion(dof)) + wp::cross(spin, row_of(problem.xipos)[of] - origin);
            lifted -= wp::dot(moved, of_world(problem.gravity)) * mass[of] * model_row(problem.body_gravcomp)[of];
        }
        row_of(problem.qfrc_gravcomp)[dof] = lifted;
        const bool is_driven = problem.jnt_actgravcomp.data[joint];
        driven += is_driven && ACTUATORS_ACT ? lifted : 0.0f;
        row_of(problem.qfrc_passive)[dof] = passive[dof] += is_driven ? 0.0f : lifted;
    }
    if (ACTUATORS_ACT && problem.jnt_actfrclimited.data[joint]) {
        const wp::vec2 range = model_row(problem.jnt_actfrcrange)[joint];
        driven = wp::clamp(driven, range[0], range[1]);
    }
    float sum = passive[dof] - bias + driven + row_of(problem.qfrc_applied)[dof];
    if (is_pushed) {
        const vec3 spin = rotation_of(motion(dof)), origin = com(look_up(problem.body_rootid, body));
#pragma unroll 1
        for (int of = body; of < body + look_up(problem.body_subtreenum, body); ++of) {
            const spatial push = row_of(problem.xfrc_applied)[of];  // its translation comes first
            const vec3 arm = row_of(problem.xipos)[of] - origin;
            sum += wp::dot(translation_of(motion(dof)) + wp::cross(spin, arm), rotation_of(push));
            sum += wp::dot(spin, translation_of(push));
        }
    }
    if (problem.is_read)
        row_of(problem.qfrc_bias)[dof] = bias;
    row_of(problem.qfrc_actuator)[dof] = driven;
    row_of(problem.qfrc_smooth)[dof] = sum;
});
