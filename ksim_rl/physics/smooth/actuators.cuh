// Activations and controls of actuators, and what these add to their joints.
#pragma once
#include "ksim_rl/physics/smooth/constants.cuh"

namespace smooth {

// What kernels take that ask for the inputs and the damping of actuators.
struct ActuatorArguments {
    wp::array_t<int> jnt_actuatorid;
    wp::array_t<int> actuator_trntype;
    wp::array_t<wp::vec2i> actuator_trnid;
    wp::array_t<wp::vec_t<6, float>> actuator_gear;
    wp::array_t<float> actuator_damping;
    wp::array_t<wp::vec2> actuator_dampingpoly;
    wp::array_t<float> dof_damping;
    wp::array_t<wp::vec2> dof_dampingpoly;
    wp::array_t<int> actuator_gaintype;
    wp::array_t<float> timestep;
    wp::array_t<float> act;
    wp::array_t<int> actuator_dyntype;
    wp::array_t<wp::vec_t<10, float>> actuator_dynprm;
    wp::array_t<wp::vec2> actuator_actrange;
    wp::array_t<bool> actuator_actlimited;
    wp::array_t<int> actuator_actadr;
    wp::array_t<int> actuator_actnum;
    wp::array_t<int> actuator_ctrlnum;
    wp::array_t<int> actuator_ctrladr;
    wp::array_t<float> ctrl;
    wp::array_t<wp::vec2> actuator_ctrlrange;
    wp::array_t<bool> actuator_ctrllimited;
    wp::array_t<bool> actuator_actearly;
};

// Calls body(actuator) for the actuators that add armature or damping to a joint: none, one, or (below -1) several.
template <class Body>
CUDA_CALLABLE inline void each_actuator_of(const ActuatorArguments& a, int joint, Body body)
{
    const int only = look_up(a.jnt_actuatorid, joint);
    if (only >= 0)
        body(only);
    for (int actuator = 0; only < -1 && actuator < NUM_ACTUATORS; ++actuator) {
        const int type = look_up(a.actuator_trntype, actuator);
        if ((type == JOINT || type == JOINTINPARENT) && a.actuator_trnid.data[actuator][0] == joint)
            body(actuator);
    }
}

// linear + poly[0] x + poly[1] x^2.
CUDA_CALLABLE inline float rate_at(float linear, const wp::vec2& poly, float x)
{
    return linear + poly[0] * x + poly[1] * x * x;
}

struct Damping {
    float linear = 0.0f;
    wp::vec2 more;
};

// Of a degree of freedom, with what actuators add.
CUDA_CALLABLE inline Damping damping_of(const World& world, const ActuatorArguments& a, int joint, int dof)
{
    Damping found;
    each_actuator_of(a, joint, [&](int actuator) {
        const float gear = world.model_row(a.actuator_gear)[actuator][0];
        found.linear += world.model_row(a.actuator_damping)[actuator] * gear * gear;
        found.more = found.more + world.model_row(a.actuator_dampingpoly)[actuator] * gear * gear;
    });
    found.linear = world.model_row(a.dof_damping)[dof] + found.linear;
    found.more = world.model_row(a.dof_dampingpoly)[dof] + found.more;
    return found;
}

// Whether the option actuatorgroupdisable disables it (disabled_actuators.py).
CUDA_CALLABLE inline bool is_switched_off(const ActuatorArguments& a, int actuator)
{
    return SOME_SWITCHED_OFF && look_up(a.actuator_gaintype, actuator) == SWITCHED_OFF;
}

// The activation at the end of the substep.
CUDA_CALLABLE inline float next_activation(const World& world, const ActuatorArguments& a, int actuator, int address, float rate)
{
    const float timestep = world.of_world(a.timestep);
    const float own = world.row_of(a.act)[address];
    float found = own + rate * timestep;
    if (look_up(a.actuator_dyntype, actuator) == FILTEREXACT) {
        const float time_constant = wp::max(TINY, world.model_row(a.actuator_dynprm)[actuator][0]);
        found = own + rate * time_constant * (1.0f - wp::exp(-timestep / time_constant));
    }
    const wp::vec2 range = world.model_row(a.actuator_actrange)[actuator];
    return a.actuator_actlimited.data[actuator] ? wp::clamp(found, range[0], range[1]) : found;
}

// Where its activation is, or -1.
CUDA_CALLABLE inline int activation_of(const ActuatorArguments& a, int actuator)
{
    const int first = HAS_ACTIVATION ? look_up(a.actuator_actadr, actuator) : -1;
    return first < 0 ? -1 : first + look_up(a.actuator_actnum, actuator) - 1;
}

CUDA_CALLABLE inline float ctrl_of(const World& world, const ActuatorArguments& a, int actuator)
{
    if (look_up(a.actuator_ctrlnum, actuator) == 0)
        return 0.0f;
    const int address = look_up(a.actuator_ctrladr, actuator);
    const float found = world.row_of(a.ctrl)[address];
    const wp::vec2 range = world.model_row(a.actuator_ctrlrange)[address];
    return CLAMPS_CTRL && a.actuator_ctrllimited.data[address] ? wp::clamp(found, range[0], range[1]) : found;
}

// What its gain multiplies: its activation, which changes at a rate, or its control where it has none.
CUDA_CALLABLE inline float input_of(const World& world, const ActuatorArguments& a, int actuator, float rate)
{
    const int address = activation_of(a, actuator);
    if (address < 0)
        return ctrl_of(world, a, actuator);
    return a.actuator_actearly.data[actuator] ? next_activation(world, a, actuator, address, rate)
                                                    : world.row_of(a.act)[address];
}

}
