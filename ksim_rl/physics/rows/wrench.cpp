// The force and torque of a contact, once the solver has found what its rows exert. It follows layout.cpp.

using vec3 = wp::vec3;
const int* const listed = row_of(problem.ids);
const int contacts = problem.count.data[world];

struct Wrench {
    vec3 force, torque;
};
// That of a contact on its second geom, in its own axes: the normal and two tangents ("mj_contactForce").
auto wrench_of = [=](int contact) {
    const int* const rows = problem.contact_efc_address.data + (size_t)contact * problem.contact_efc_address.shape[1];
    const float* const friction = (const float*)(problem.contact_friction.data + contact);
    const float* const forces = row_of(problem.efc_force);
    // Rows beyond the last one that there is room for exert nothing.
    auto of_row = [=](int row) { return row < NJMAX ? forces[row] : 0.0f; };
    float along[6] = {};
    const int dim = rows[0] < 0 ? 0 : problem.contact_dim.data[contact];
    if (ELLIPTIC || dim == 1)
        for (int axis = 0; axis < dim; ++axis)
            along[axis] = of_row(rows[axis]);
    else
        for (int axis = 1; axis < dim; ++axis) {
            const float plus = of_row(rows[0] + 2 * axis - 2), minus = of_row(rows[0] + 2 * axis - 1);
            along[0] += plus + minus;
            along[axis] = (plus - minus) * friction[axis - 1];
        }
    if (dim > 0)
        along[0] -= problem.contact_adhesion.data[contact];
    return Wrench{vec3(along[0], along[1], along[2]), vec3(along[3], along[4], along[5])};
};
auto axis_of = [=](int contact, int axis) {
    const float* const axes = (const float*)(problem.contact_frame.data + contact) + 3 * axis;
    return vec3(axes[0], axes[1], axes[2]);
};
auto in_world = [=](int contact, const vec3& v) {
    return v[0] * axis_of(contact, 0) + v[1] * axis_of(contact, 1) + v[2] * axis_of(contact, 2);
};
