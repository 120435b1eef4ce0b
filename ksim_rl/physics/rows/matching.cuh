// Whether a geom of a contact is of the object that a sensor names.
#pragma once
#include "builtin.h"

namespace contacts {

namespace given {
// Kinds of objects.
constexpr int NOTHING = 0;
constexpr int GEOM = 5;
constexpr int BODY = 1;
constexpr int SUBTREE = 2;
}

using namespace given;

// What kernels take that ask for the objects of sensors.
struct MatchArguments {
    wp::array_t<int> geom_bodyid;
    wp::array_t<int> body_subtreenum;
};

CUDA_CALLABLE inline bool is_of(const MatchArguments& a, int geom, int kind, int element)
{
    if (kind == NOTHING || kind == GEOM)
        return kind == NOTHING || geom == element;
    const int body = a.geom_bodyid.data[geom];
    return body >= element && body < element + (kind == SUBTREE ? a.body_subtreenum.data[element] : 1);
}

}
