// Part 3: what makes a row: its place, and the law of the spring and damper that it is.
//
// A row has the distance `position` of what it holds off its bound, J, and the velocity J qvel. Its reference is
// the acceleration aref = -b (J qvel) - k d(position) position, and D is the inverse of its regularization
// (1 - d) / d times its inverse inertia, with the impedance d in (0, 1) ("Constraint model: Parameters").

using vec3 = wp::vec3;
using quat = wp::quat;
using mask64 = unsigned long long;  // of degrees of freedom

constexpr float TINY = 1e-15f, LEAST_IMPEDANCE = 1e-4f, MOST_IMPEDANCE = 0.9999f, PI = 3.14159265f;

auto of_world = [=](auto& array) { return array.data[array.shape[0] > 1 ? world : 0]; };
const float timestep = of_world(problem.timestep);
const float* const qpos = row_of(problem.qpos);
const float* const qvel = row_of(problem.qvel);
float* const jacobian = row_of(problem.efc_J);
int* const columns = row_of(problem.efc_J_colind);
int* const owners = row_of(problem.efc_id);

// Rows take their places in turns of all lanes. Those beyond NJMAX are counted, and not written. From the first ones on
// whose nonzeros do not fit, no rows are made, nor counted.
int rows_asked = 0, rows_made = 0, nonzeros_asked = 0;
struct Place {
    int row, address, rows;  // the first row, where its nonzeros begin, and how many rows are written
};
auto reserve = [&](int rows, int nonzeros) {
    Place place;
    place.row = rows_asked + sum_before(rows);
    place.rows = wp::clamp(NJMAX - place.row, 0, rows);
    const int floats = place.rows * nonzeros;
    place.address = nonzeros_asked + sum_before(floats);
    const bool fits = place.address + floats <= MOST_NONZEROS;
    const int made = fits ? rows : 0;
    rows_made = of_lane(rows_made + sum_before(made) + made, LANES - 1);
    rows_asked = of_lane(place.row + rows, LANES - 1);
    nonzeros_asked = of_lane(place.address + floats, LANES - 1);
    place.rows = fits ? place.rows : 0;
    return place;
};
// Calls body(item, whether there is one) in all lanes at once.
auto in_turns = [&](int count, auto body) {
#pragma unroll 1
    for (int first = 0; first < count; first += LANES)
        body(first + lane, first + lane < count);
};

struct Law {
    float stiffness, damping, impedance;
};
auto law_of = [=](const auto& solref, const auto& solimp, float position) {
    const float time = REFSAFE ? wp::max(solref[0], 2.0f * timestep) : solref[0], ratio = solref[1];
    const float least = wp::clamp(solimp[0], LEAST_IMPEDANCE, MOST_IMPEDANCE);
    const float most = wp::clamp(solimp[1], LEAST_IMPEDANCE, MOST_IMPEDANCE);
    const float middle = wp::clamp(solimp[3], LEAST_IMPEDANCE, MOST_IMPEDANCE);
    const float power = wp::max(1.0f, solimp[4]), part = wp::abs(position) / wp::max(TINY, solimp[2]);
    Law law;
    // A reference that is not positive gives stiffness and damping directly.
    law.stiffness = solref[0] <= 0.0f ? -solref[0] / wp::max(TINY, most * most)
                                      : 1.0f / wp::max(TINY, most * most * time * time * ratio * ratio);
    law.damping = ratio <= 0.0f ? -ratio / wp::max(TINY, most) : 2.0f / wp::max(TINY, most * time);
    if (least == most || solimp[2] <= TINY)
        law.impedance = 0.5f * (least + most);
    else if (part <= 0.0f)
        law.impedance = least;
    else if (part >= 1.0f)
        law.impedance = most;
    else if (power == 1.0f)
        law.impedance = least + part * (most - least);
    else {
        const bool is_upper = part > middle;
        const float x = is_upper ? 1.0f - part : part, at = is_upper ? 1.0f - middle : middle;
        // As in C; a power of two, the usual one, needs no logarithms.
        const float curved = power == 2.0f ? x * x / at : wp::pow(x, power) / wp::pow(at, power - 1.0f);
        const float rise = is_upper ? 1.0f - curved : curved;
        law.impedance = wp::clamp(least + rise * (most - least), least, most);
    }
    return law;
};
struct Row {
    int type, owner;  // the equality, degree of freedom, joint or contact that it belongs to
    float position, margin, velocity, invweight, frictionloss, softness;  // softness divides D
};
auto write_row = [=](int row, const Row& a, const Law& law) {
    const float regularization = wp::max(a.invweight * (1.0f - law.impedance) / law.impedance, TINY);
    row_of(problem.efc_type)[row] = a.type;
    owners[row] = a.owner;
    row_of(problem.efc_pos)[row] = a.position + a.margin;
    row_of(problem.efc_margin)[row] = a.margin;
    row_of(problem.efc_vel)[row] = a.velocity;
    row_of(problem.efc_D)[row] = 1.0f / regularization / a.softness;
    row_of(problem.efc_aref)[row] = -law.stiffness * law.impedance * a.position - law.damping * a.velocity;
    row_of(problem.efc_frictionloss)[row] = a.frictionloss;
};
auto write_nonzero = [=](int address, int dof, float value) {
    columns[address] = dof;
    jacobian[address] = value;
};
