// Part 3: the contacts of pairs that are near each other, which are kept on the chip and then written to the pool, and the
// pairs for MuJoCo Warp's narrow phase. What a contact has of its two geoms is in "Contact parameters" of
// https://mujoco.readthedocs.io/en/stable/modeling.html#contact-parameters.

constexpr float LEAST_FRICTION = 1e-5f;
constexpr int BITS = 16, CHUNK = BITS * LANES, ROOM = 2 * LANES;
struct Found {
    Touch touch;
    int pair, which;
};
#if defined(__CUDA_ARCH__)
__shared__ unsigned short all_near[THREADS / LANES][CHUNK];
__shared__ __align__(16) char all_contacts[THREADS / LANES][ROOM * sizeof(Found)];
unsigned short* const near = all_near[threadIdx.x / LANES];
Found* const contacts = (Found*)all_contacts[threadIdx.x / LANES];
#else
unsigned short near[CHUNK];
Found contacts[ROOM];
#endif
int num_contacts = 0, num_listed = 0;  // those on the chip, and those that were written

// How many lanes before this one have it, and how many all.
struct Lanes {
    int before, all;
};
auto lanes_with = [&](bool has) {
#if defined(__CUDA_ARCH__)
    const unsigned with = (__ballot_sync(own_lanes, has) & own_lanes) >> (threadIdx.x % 32 / LANES * LANES);
    return Lanes{__popc(with & ((1u << lane) - 1u)), __popc(with)};
#else
    return Lanes{0, has};
#endif
};
// Takes places of a pool that all worlds share, and returns the first.
auto take = [&](int* counter, int count) {
    int first = 0;
    if (lane == 0) {
#if defined(__CUDA_ARCH__)
        first = atomicAdd(counter, count);
#else
        first = *counter;
        *counter += count;
#endif
    }
    return of_lane(first, 0);
};
// A frame whose first tangent is as near as can be to one that is given, or to an axis of the world.
auto frame_of = [](const vec3& normal, const vec3& wanted) {
    vec3 tangent = wanted - normal * wp::dot(wanted, normal);
    if (wp::length(tangent) <= 1e-6f) {
        tangent = wp::abs(normal[1]) < 0.5f ? vec3(0.0f, 1.0f, 0.0f) : vec3(0.0f, 0.0f, 1.0f);
        tangent = tangent - normal * wp::dot(tangent, normal);
    }
    tangent = wp::normalize(tangent);
    const vec3 last = wp::cross(normal, tangent);
    return wp::mat33(
        normal[0], normal[1], normal[2], tangent[0], tangent[1], tangent[2], last[0], last[1], last[2]
    );
};
// What a capsule on a plane has for that: its own direction, and where it stands upright the first axis of the world.
auto direction_of = [&](int capsule, const vec3& normal) {
    const vec3 along = axis(turns[capsule], 2);
    return wp::length(wp::cross(along, normal)) > 1e-6f ? along : vec3(1.0f, 0.0f, 0.0f);
};
auto write = [&](const Found& found, int place, bool is_listed) {
    const int a = pairs[found.pair][0], b = pairs[found.pair][1], pair = HAS_PAIRS ? pair_ids[found.pair][0] : -1;
    const bool follows = problem.geom_type.data[a] == PLANE && problem.geom_type.data[b] == CAPSULE;
    float margin = 0.0f, adhesion = 0.0f;
    if (HAS_MARGINS)
        margin = pair >= 0 ? model_row(problem.pair_margin)[pair]
                           : model_row(problem.geom_margin)[a] + model_row(problem.geom_margin)[b];
    int dim = 0;
    auto& friction = problem.contact_friction.data[place];
    if (pair >= 0) {
        dim = problem.pair_dim.data[pair];
        adhesion = model_row(problem.pair_adhesion)[pair];
        problem.contact_solref.data[place] = model_row(problem.pair_solref)[pair];
        problem.contact_solreffriction.data[place] = model_row(problem.pair_solreffriction)[pair];
        problem.contact_solimp.data[place] = model_row(problem.pair_solimp)[pair];
        for (int i = 0; i < 5; ++i)
            friction[i] = wp::max(LEAST_FRICTION, model_row(problem.pair_friction)[pair][i]);
    } else {
        const int* const priority = problem.geom_priority.data;
        const int* const dims = problem.geom_condim.data;
        const auto &own = model_row(problem.geom_friction)[a], &other = model_row(problem.geom_friction)[b];
        const auto &law = model_row(problem.geom_solref)[a], &law_b = model_row(problem.geom_solref)[b];
        const auto &curve = model_row(problem.geom_solimp)[a], &curve_b = model_row(problem.geom_solimp)[b];
        const float weight = model_row(problem.geom_solmix)[a], weight_b = model_row(problem.geom_solmix)[b];
        // The first geom's share.
        float mix = weight >= 1e-15f && weight_b >= 1e-15f ? weight / (weight + weight_b)
            : weight >= 1e-15f                             ? 1.0f
            : weight_b >= 1e-15f                           ? 0.0f
                                                           : 0.5f;
        const bool first = priority[a] >= priority[b], second = priority[b] >= priority[a];
        if (!first || !second)
            mix = first ? 1.0f : 0.0f;
        dim = wp::max(first ? dims[a] : 0, second ? dims[b] : 0);
        const auto* const adhesions = model_row(problem.geom_adhesion);
        adhesion = (first ? adhesions[a] : 0.0f) + (second ? adhesions[b] : 0.0f);
        for (int i = 0; i < 5; ++i) {
            const int kind = (i > 1) + (i > 2);  // sliding twice, spinning, rolling twice
            friction[i] = wp::max(
                LEAST_FRICTION, wp::max(first ? own[kind] : 0.0f, second ? other[kind] : 0.0f)
            );
            problem.contact_solimp.data[place][i] = mix * curve[i] + (1.0f - mix) * curve_b[i];
        }
        for (int i = 0; i < 2; ++i) {
            const bool mixes = (law[0] > 0.0f && law_b[0] > 0.0f) || !first || !second;
            problem.contact_solref.data[place][i] =
                mixes ? mix * law[i] + (1.0f - mix) * law_b[i] : wp::min(law[i], law_b[i]);
            problem.contact_solreffriction.data[place][i] = 0.0f;
        }
    }
    const Touch& touch = found.touch;
    problem.contact_dist.data[place] = touch.distance;
    problem.contact_pos.data[place] = touch.position;
    problem.contact_frame.data[place] = frame_of(touch.normal, follows ? direction_of(b, touch.normal) : vec3());
    problem.contact_includemargin.data[place] = margin;
    problem.contact_dim.data[place] = adhesion != 0.0f && touch.distance >= margin ? 1 : dim;
    problem.contact_geom.data[place] = wp::vec2i(a, b);
    problem.contact_worldid.data[place] = world;
    problem.contact_type.data[place] = HAS_ROWS;
    problem.contact_geomcollisionid.data[place] = found.which;
    problem.contact_adhesion.data[place] = adhesion;
    // The kernel of the rows writes those of contacts that are listed.
    const int most = is_listed ? 0 : problem.contact_efc_address.shape[1];
    for (int row = 0; row < most; ++row)
        problem.contact_efc_address.data[place * most + row] = -1;
};
auto flush = [&] {
    sync();
    if (num_contacts > 0) {
        const int first = take(problem.nacon.data, num_contacts);
        const int kept = wp::clamp(problem.naconmax - first, 0, num_contacts);
        each(kept, [&](int item) {
            const bool is_listed = problem.lists && num_listed + item < problem.found.shape[1];
            write(contacts[item], first + item, is_listed);
            if (is_listed)
                row_of(problem.found)[num_listed + item] = first + item;
        });
        num_listed += kept;
    }
    num_contacts = 0;
    sync();
};

for (int begin = 0; begin < num_pairs; begin += CHUNK) {
    // Few pairs are near each other: they are listed first, so that no lane waits for another's.
    const int size = wp::min(CHUNK, num_pairs - begin);
    int num_near = 0;
    for (int item = lane; item - lane < size; item += LANES) {
        const bool passes = item < size && are_near(begin + item);
        const Lanes lanes = lanes_with(passes);
        if (passes)
            near[num_near + lanes.before] = item;
        num_near += lanes.all;
    }
    sync();
    for (int item = lane; item - lane < num_near; item += LANES) {
        const int pair = begin + near[wp::min(item, num_near - 1)], a = pairs[pair][0], b = pairs[pair][1];
        const float margin = margin_of(a, b, HAS_MARGINS ? pair_ids[pair][0] : -1);
        int most = item < num_near ? pairs[pair][2] : 0;
        if (OTHERS) {
            const bool is_theirs = item < num_near && most == 0 && may_touch(pair);
            const Lanes lanes = lanes_with(is_theirs);
            const int place = lanes.all > 0 ? take(problem.ncollision.data, lanes.all) + lanes.before : 0;
            if (is_theirs && place < problem.naconmax) {
                problem.collision_pair.data[place] = wp::vec2i(a, b);
                problem.collision_pairid.data[place] = pair_ids[pair];
                problem.collision_worldid.data[place] = world;
            }
        }
        if (most > 0 && problem.geom_type.data[b] == BOX && !may_touch(pair))
            most = 0;
        for (int which = 0; lanes_with(which < most).all > 0; ++which) {
            Touch touch;
            if (which < most)
                touch = touch_of(a, b, which);
            const bool touches = touch.distance < margin;
            const Lanes lanes = lanes_with(touches);
            if (num_contacts + lanes.all > ROOM)
                flush();
            if (touches)
                contacts[num_contacts + lanes.before] = Found{touch, pair, which};
            num_contacts += lanes.all;
        }
    }
    sync();
}
flush();
if (lane == 0 && problem.lists)
    problem.appended.data[world] = num_listed;
