"""Undocumented interfaces of MuJoCo Warp that `physics` uses.

Each part says why it is needed; all were checked with MuJoCo Warp 4.0.0 and Warp 1.19.0, which pyproject.toml bounds.
`tests/physics/test_upstream.py` names the part that a new version moved.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from jaxtyping import Float32

# Building blocks of its contacts. A contact that another kernel appends has to look exactly like its own. And what it
# does with quaternions.
from mujoco_warp._src.bvh import build_hfield_bvh
from mujoco_warp._src.collision_core import contact_params as contact_params

# The lists between its broad phase and its narrow one, the narrow phase, and what follows it.
from mujoco_warp._src.collision_core import create_collision_context as create_collision_context

# Its search for the distance of convex shapes, and the parts that it needs.
from mujoco_warp._src.collision_core import geom_collision_pair as geom_collision_pair
from mujoco_warp._src.collision_core import write_contact as write_contact
from mujoco_warp._src.collision_driver import _contact_surfacevel as velocities_of_surfaces
from mujoco_warp._src.collision_driver import _narrowphase as narrowphase  # noqa: F401
from mujoco_warp._src.collision_gjk import ccd as ccd
from mujoco_warp._src.collision_gjk import support as support

# The law of a constraint row.
from mujoco_warp._src.constraint import _efc_row as efc_row  # noqa: F401

# The derivatives that an implicit integrator subtracts from the inertia matrix.
from mujoco_warp._src.derivative import deriv_smooth_vel as derivative_of_smooth_forces  # noqa: F401

# How it ends, and what `forward` does between the stages that it shows.
from mujoco_warp._src.forward import _advance as advance  # noqa: F401
from mujoco_warp._src.forward import _energy_pos as energy_of_position  # noqa: F401
from mujoco_warp._src.forward import _energy_vel as energy_of_velocity  # noqa: F401
from mujoco_warp._src.forward import _launch_discrete_free_gyro as turn_free_bodies
from mujoco_warp._src.forward import implicit_free_body as solve_for_lone_bodies  # noqa: F401
from mujoco_warp._src.math import make_frame as make_frame
from mujoco_warp._src.math import mul_quat as mul_quat
from mujoco_warp._src.math import quat_to_mat as quat_to_mat
from mujoco_warp._src.math import rot_vec_quat as rot_vec_quat
from mujoco_warp._src.sleep import update_sleep, wake

# How it solves, and what a step adds to the inertia matrix and to the bias forces for tendons.
from mujoco_warp._src.smooth import factor_solve_i as factor_and_solve  # noqa: F401
from mujoco_warp._src.smooth import tendon_armature as tendon_armature
from mujoco_warp._src.smooth import tendon_bias as tendon_bias

# How much memory that search needs, and the corners of a prism.
from mujoco_warp._src.types import MJ_MAX_EPAFACES as MJ_MAX_EPAFACES
from mujoco_warp._src.types import MJ_MAX_EPAHORIZON as MJ_MAX_EPAHORIZON

# The bits of `contact.type`.
from mujoco_warp._src.types import ContactType as ContactType

# When its callback of sensors is called.
from mujoco_warp._src.types import Stage as Stage

# The type of a contact's friction and of its impedance.
from mujoco_warp._src.types import vec5 as vec5
from mujoco_warp._src.types import vec10 as vec10
from torch import Tensor

# The type that `wp.struct` makes, which annotations need.
from warp._src.codegen import Struct as Struct

GEOM_TYPES = {kind.name: int(kind) for kind in mjw.GeomType}
FIXED = int(mjw.SetConstGroup.FIXED)
# The two columns of `nxn_pairid` for a pair that never makes a contact, and for one that no sensor measures; and the
# first for a pair that may touch without a <pair> of its own.
NO_CONTACT = -2
NO_SENSOR = -1
NO_PAIR = -1
# Of what is in `sensor_acc_adr`, those that read no accelerations and forces of bodies.
FORCELESS = mujoco.mjtSensor.mjSENS_ACTUATORFRC, mujoco.mjtSensor.mjSENS_JOINTACTFRC


def per_world_fields() -> tuple[str, ...]:
    """Return the names of all model fields that may differ between worlds.

    `put_model(batch_sizes=...)` accepts them but does not list them; their annotations have "*" as the first size.
    """
    return tuple(
        field.name
        # Annotations of such fields begin with "*" as the first size.
        for field in dataclasses.fields(mjw.Model)
        if (getattr(field.type, "shape", None) or ("",))[0] == "*"
    )


def drop_unread(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Free the arrays that only other integrators and sleeping worlds need: a tenth of all, made for each model.

    Whatever MuJoCo Warp launches for this model takes them along unread, if at all.
    """
    m = warp_model
    d = warp_data_E
    kinds = mjw.IntegratorType
    # The integrator "discrete" needs these arrays.
    if m.opt.integrator == kinds.DISCRETE:
        names = ""
    else:
        names = "qH qHLD qHDiagInv efm_fluid "
    names += "" if m.opt.integrator == kinds.IMPLICIT else "qLU "
    if not m.opt.enableflags & mjw.EnableBit.SLEEP:
        names += "map_iefc2efc map_efc2iefc efc_islandid map_idof2dof map_dof2idof dof_islandid"
        d.efc.island = wp.empty((0, d.njmax), dtype=int)
    # Empty arrays of the same dims: kernels may still take them as arguments.
    for name in names.split():
        array = getattr(d, name)
        setattr(d, name, wp.empty((0, *array.shape[1:]), dtype=array.dtype))


def expand_gravity(warp_model: mjw.Model, num_envs: int) -> Float32[Tensor, "E 3"]:
    """Give each world its own gravity vector, and return the view, in m/s^2.

    `batch_sizes` refuses gravity, since it is a field of the options. Kernels index it modulo its length, and the flag
    tells MuJoCo Warp's helpers that its first dim is the world.
    """
    # A copy, since an expanded view has one row in memory for all worlds.
    shared = wp.to_torch(warp_model.opt.gravity)
    gravity = wp.from_torch(shared.expand(num_envs, 3).contiguous(), dtype=wp.vec3)
    setattr(gravity, "_is_batched", True)  # noqa: B010
    warp_model.opt.gravity = gravity
    return wp.to_torch(gravity)


def set_fixed_constants(warp_model: mjw.Model) -> None:
    """Launch `set_const` for the constants that follow from fields alone: it takes Data, and does not read it."""
    mjw.set_const(warp_model, None, FIXED)  # pyright: ignore[reportArgumentType]


def may_sleep(options: mujoco.MjOption | mjw.Option) -> bool:
    """Return whether trees may fall asleep, by the options of a model of MuJoCo or of MuJoCo Warp."""
    # Islands fall asleep, so that nothing does where they are switched off.
    has_islands = not options.disableflags & mjw.DisableBit.ISLAND
    return has_islands and bool(options.enableflags & mjw.EnableBit.SLEEP)


def wake_trees(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Wake the sleeping trees that something disturbs, as `forward` does first."""
    if may_sleep(warp_model.opt):
        wake(warp_model, warp_data_E)
        update_sleep(warp_model, warp_data_E)


def solve_as_they_do(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch MuJoCo Warp's own solver, and the terms that its integrator "discrete" adds to the accelerations."""
    mjw.solve(warp_model, warp_data_E)
    if warp_model.opt.integrator == mjw.IntegratorType.DISCRETE:
        turn_free_bodies(warp_model, warp_data_E, warp_data_E.qacc, warp_data_E.qacc, False)


def bias_forces(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch `qfrc_bias` and nothing else: `rne` writes accelerations and forces of bodies, too.

    Those that may be read are of the last substep.
    """
    d = warp_data_E
    # Scratch arrays take the other outputs of `rne`.
    aside = dataclasses.replace(d, cacc=wp.empty_like(d.cacc), cfrc_int=wp.empty_like(d.cfrc_int))
    mjw.rne(warp_model, aside)
    tendon_bias(warp_model, d, d.qfrc_bias)


def give_velocities_of_surfaces(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch the velocities of surfaces of all contacts again: those that we append come after its own launch."""
    d = warp_data_E
    contact = d.contact
    inputs = [
        warp_model.geom_surfacevel,
        d.geom_xpos,
        d.geom_xmat,
        contact.pos,
        contact.frame,
        contact.geom,
    ]
    inputs += [contact.worldid, d.naconmax, d.nacon]
    wp.launch(velocities_of_surfaces, dim=d.naconmax, inputs=inputs, outputs=[contact.surfacevel])


def without_limit_sensors(warp_model: mjw.Model) -> mjw.Model:
    """Return a model on the same arrays without the sensors of joint and tendon limits."""
    none = wp.zeros(0, dtype=int)
    lists = ("sensor_limitpos_adr", "sensor_limitvel_adr", "sensor_limitfrc_adr")
    return dataclasses.replace(warp_model, **dict.fromkeys(lists, none))


def without_sensors(warp_model: mjw.Model) -> mjw.Model:
    """Return a model on the same arrays that computes no sensors."""
    disabled = int(warp_model.opt.disableflags) | int(mjw.DisableBit.SENSOR)
    opt = dataclasses.replace(warp_model.opt, disableflags=disabled)
    return dataclasses.replace(warp_model, opt=opt)


def sensors_by_refresh(
    warp_model: mjw.Model, *, skip: np.ndarray, sensor_type: np.ndarray
) -> tuple[mjw.Model, mjw.Model]:
    """Return two models on the same arrays: with the sensors that follow from qpos and qvel alone, and with the others.

    Contact, limit, touch-grid and geom-distance sensors read rows or contacts of the last substep's collision pass.
    They, and the sensors of `skip` (bool [nsensor]), keep that substep's value; rows that reset since then read zero.
    Sensors can only be switched off all together, so the lists that `put_model` makes, one per kernel, are replaced.
    """
    none = wp.zeros(0, dtype=int)
    # Lists of ids, which are split by whether a refresh may compute the sensor.
    stages = {
        name: getattr(warp_model, name).numpy() for name in ("sensor_pos_adr", "sensor_vel_adr")
    }
    refreshed, kept = (
        {
            name: wp.array([i for i in ids if skip[i] == skips], dtype=int)
            for name, ids in stages.items()
        }
        for skips in (False, True)
    )
    lists = ("limitpos", "limitvel", "contact_pos", "contact_vel", "stage_pos", "stage_vel")
    # Rangefinders have a count and no list: one of the two models has them all.
    keeps_rays = bool(np.any(skip & (sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER)))
    rays = warp_model.nrangefinder
    # Contacts and limits belong to the last substep: their lists are empty here.
    of_refresh = dataclasses.replace(
        warp_model,
        **{f"sensor_{name}_adr": none for name in lists},
        **refreshed,
        nrangefinder=0 if keeps_rays else rays,
        nsensorcollision=0,
        nsensortaxel=0,
    )
    # Only sensors of the refresh read these sums.
    sums = dict.fromkeys(("sensor_subtree_vel", "sensor_e_potential", "sensor_e_kinetic"), False)
    of_substep = dataclasses.replace(
        warp_model, **kept, **sums, nrangefinder=rays if keeps_rays else 0
    )
    return of_refresh, of_substep


def with_contact_sensors_only(warp_model: mjw.Model) -> mjw.Model:
    """Return a model on the same arrays that computes contact sensors only."""
    none = wp.zeros(0, dtype=int)
    lists = ("pos", "vel", "acc", "touch", "limitpos", "limitvel", "limitfrc", "tendonactfrc")
    flags = (
        "sensor_rne_postconstraint",
        "sensor_subtree_vel",
        "sensor_e_potential",
        "sensor_e_kinetic",
    )
    counts = dict.fromkeys(("nrangefinder", "nsensorcollision", "nsensortaxel"), 0)
    own = {f"sensor_{name}_adr": none for name in lists} | dict.fromkeys(flags, False)
    return dataclasses.replace(warp_model, **own, **counts)


def without(sensors: Sequence[int], warp_model: mjw.Model) -> mjw.Model:
    """Return a model on the same arrays without these sensors, nor forces of all bodies if no other reads them."""
    m = warp_model
    left = dict[str, np.ndarray]()
    for stage in ("contact_pos", "contact_vel", "contact_acc", "acc"):
        ids = vars(m)[f"sensor_{stage}_adr"].numpy()
        left[f"sensor_{stage}_adr"] = ids[~np.isin(ids, sensors)]
    # Forces of all bodies are costly, and needed by few sensors.
    reads_forces = not np.isin(m.sensor_type.numpy()[left["sensor_acc_adr"]], FORCELESS).all()
    lists = {name: wp.array(ids, dtype=int) for name, ids in left.items()}
    return dataclasses.replace(m, **lists, sensor_rne_postconstraint=reads_forces)


def collide_boxes_exactly(warp_model: mjw.Model) -> None:
    """Let boxes collide as in C, by separating axes and clipping, in place, instead of by GJK and EPA.

    MuJoCo Warp has that port, and takes it for models with the flag below, which nothing else of it heeds; C always
    collides boxes that way.
    """
    warp_model.opt.disableflags |= int(mjw.DisableBit.NATIVECCD)


def geom_pairs(warp_model: mjw.Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the geom pairs that the broad phase looks at, [N, 2], and their ids, [N, 2]."""
    return warp_model.nxn_geom_pair.numpy(), warp_model.nxn_pairid.numpy()


def repeated_pairs(warp_model: mjw.Model) -> np.ndarray:
    """Return the <pair>s whose geoms a later <pair> has, too, int [N]."""
    # Two geoms are a pair in either order.
    geoms = np.stack([warp_model.pair_geom1.numpy(), warp_model.pair_geom2.numpy()], axis=-1)
    low = geoms.min(-1)
    high = geoms.max(-1)
    # One number for each unordered pair, in int64 since the product may exceed 32 bits.
    names = low.astype(np.int64) * warp_model.ngeom + high
    # Of equal names, the last one counts; found from the end.
    _, last = np.unique(names[::-1], return_index=True)
    return np.setdiff1d(np.arange(names.size), names.size - 1 - last)


def take_pairs_as_written(warp_model: mjw.Model) -> None:
    """Let all <pair>s make contacts, in place, with the normal from the first geom to the second as in C.

    `put_model` keeps one number for two geoms, the last one's. The others stand at the end of the lists, beyond those
    that are found by their geoms. Pairs that sensors measure keep the order of the geoms, on which these count.
    """
    m = warp_model
    repeated = repeated_pairs(warp_model)
    if m.pair_dim.size == 0:
        return
    geoms = np.stack([m.pair_geom1.numpy(), m.pair_geom2.numpy()], axis=-1)
    pairs, pair_ids = (array.copy() for array in geom_pairs(m))
    # Pairs without a sensor may be turned around without harm.
    as_written = (pair_ids[:, 0] > NO_PAIR) & (pair_ids[:, 1] == NO_SENSOR)
    pairs[as_written] = geoms[pair_ids[as_written, 0]]
    # Earlier <pair>s of the same geoms are appended, without a sensor.
    own_ids = np.stack([repeated, np.full_like(repeated, NO_SENSOR)], axis=-1)
    pairs = np.concatenate([pairs, geoms[repeated]]).astype(np.int32)
    pair_ids = np.concatenate([pair_ids, own_ids]).astype(np.int32)
    m.nxn_geom_pair = wp.array(pairs, dtype=wp.vec2i)
    m.nxn_pairid = wp.array(pair_ids, dtype=wp.vec2i)
    if repeated.size:
        # To sweep and prune finds pairs by their geoms.
        m.opt.broadphase = mjw.BroadphaseType.NXN
    # No pair is dropped: this makes the filtered lists again.
    drop_contacts(m, np.zeros(len(pairs), dtype=bool))


def pair_type_counts(warp_model: mjw.Model, pairs: np.ndarray) -> tuple[int, ...]:
    """Return the number of pairs of geoms [N, 2] by their types, in the order of a matrix's upper triangle."""
    types = warp_model.geom_type.numpy()[pairs]
    kinds = len(mjw.GeomType)
    # The place in the upper triangle, row by row.
    low = types.min(-1)
    high = types.max(-1)
    places = (low * (2 * kinds - low - 1)) // 2 + high
    return tuple(np.bincount(places, minlength=kinds * (kinds + 1) // 2).tolist())


def drop_contacts(warp_model: mjw.Model, dropped: np.ndarray) -> None:
    """Let MuJoCo Warp make no contacts of some geom pairs, in place: it has no setting for a pair.

    Sensors still measure them. `dropped` is bool [N], in the order of `geom_pairs`.
    """
    pairs, pair_ids = geom_pairs(warp_model)
    left_ids = pair_ids.copy()
    left_ids[dropped, 0] = NO_CONTACT
    # MuJoCo Warp looks at these lists only, not at all pairs.
    may_touch = (left_ids[:, 0] > NO_CONTACT) | (left_ids[:, 1] > NO_SENSOR)
    warp_model.nxn_pairid = wp.array(left_ids, dtype=wp.vec2i)
    warp_model.nxn_pairid_filtered = wp.array(left_ids[may_touch], dtype=wp.vec2i)
    warp_model.nxn_geom_pair_filtered = wp.array(pairs[may_touch], dtype=wp.vec2i)
    warp_model.geom_pair_type_count = pair_type_counts(warp_model, pairs[may_touch])


def measure_without_contacts(warp_model: mjw.Model) -> None:
    """Let sensors of distances be read where contacts are disabled, in place.

    They come from the collision pass, which MuJoCo Warp then leaves out: it gets one in which no pair makes contacts.
    """
    m = warp_model
    contact = int(mjw.DisableBit.CONTACT)
    if m.nsensorcollision and m.opt.disableflags & contact:
        m.opt.disableflags &= ~contact
        drop_contacts(m, np.ones(m.nxn_pairid.shape[0], dtype=bool))


def add_height_fields(context: mjw.RenderContext, mj_model: mujoco.MjModel) -> None:
    """Let a renderer draw all height fields of the model: its own are those that `geom_dataid` names in the model.

    Worlds may differ in that field, and so show patches of ground that the model itself does not.
    """
    ids = context.hfield_bvh_id.numpy()
    bounds = context.hfield_bounds_size.numpy()
    for field in range(mj_model.nhfield):
        # Fields that the model itself shows are there already.
        if not ids[field]:
            mesh, bounds[field] = build_hfield_bvh(mj_model, field, constructor="cubql")
            context.hfield_registry[mesh.id] = mesh
            ids[field] = mesh.id
    context.hfield_bvh_id = wp.array(ids, dtype=wp.uint64)
    context.hfield_bounds_size = wp.array(bounds, dtype=wp.vec3)
