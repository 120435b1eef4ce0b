// The constraint rows of one world. Read the parts in their order: contact_order.cuh, row.cuh, joints.cuh, contacts.cuh.
#pragma once
#include "ksim_rl/physics/rows/contacts.cuh"
#include "ksim_rl/physics/rows/joints.cuh"

namespace constraint_rows {

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
    const World world = world_of(index, lane);
    const int appended = a.appended.data[index], contacts = order_contacts(world, a);
    Rows rows(world, a);
    tie_joints(rows);
    const int equalities = rows.made;
    slow_joints(rows);
    const int frictions = rows.made - equalities;
    limit_joints(rows);
    const int limits = rows.made - equalities - frictions;
    const int first_contact_row = rows.made;
    place_contacts(rows, contacts);
    sync();
    write_contacts(rows, first_contact_row);
    if (lane == 0) {
        // Of contacts that the list had no room for it is only known how many rows they have at most.
        const int beyond = wp::max(0, appended - ROOM) * a.contact_efc_address.shape[1];
        a.ne.data[index] = equalities;
        a.nf.data[index] = frictions;
        a.nl.data[index] = limits;
        a.nefc.data[index] = beyond > 0 ? wp::max(rows.made, NJMAX) + beyond : rows.made;
        if (rows.nonzeros_asked > MOST_NONZEROS)
            a.overflow.data[index] |= OUT_OF_NONZEROS;
    }
}

}
