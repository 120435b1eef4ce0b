// Whether a geom of a contact is of the object that a sensor names. It follows wrench.cpp.

auto is_of = [=](int geom, int kind, int element) {
    if (kind == NOTHING || kind == GEOM)
        return kind == NOTHING || geom == element;
    const int body = problem.geom_bodyid.data[geom];
    return body >= element && body < element + (kind == SUBTREE ? problem.body_subtreenum.data[element] : 1);
};
