"""What physics uses of MuJoCo Warp beyond its documents is still there; each failure names the thing that moved."""

import dataclasses
import hashlib
import inspect
import re
from importlib import import_module, metadata
from pathlib import Path

import mujoco
import mujoco_warp as mjw
import pytest
import warp as wp

from ksim_rl.physics import upstream

ROOT = Path(__file__).parents[2]
MODEL = """
<mujoco>
  <asset><hfield name="hills" nrow="3" ncol="3" size="1 1 0.1 0.1"/></asset>
  <worldbody>
    <geom type="hfield" hfield="hills"/>
    <body pos="0 0 1"><freejoint/><geom size="0.1"/><geom type="box" size="0.1 0.1 0.1" pos="1 0 0"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def warp_model() -> mjw.Model:
    with wp.ScopedDevice("cpu"):
        return mjw.put_model(mujoco.MjModel.from_xml_string(MODEL))


# Of Warp functions, kernels pass the arguments by their order.
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        (
            "constraint._efc_row",
            "opt_disableflags worldid timestep efcid pos_aref pos_imp invweight solref solimp margin vel frictionloss "
            "type id is_discrete aref_shift type_out id_out pos_out margin_out D_out vel_out aref_out frictionloss_out",
        ),
        ("bvh.build_hfield_bvh", "mjm hfieldid constructor leaf_size"),
        ("math.make_frame", "a"),
        ("math.mul_quat", "u v"),
        ("math.quat_to_mat", "quat"),
        ("math.rot_vec_quat", "vec quat"),
        ("smooth.tendon_armature", "m d"),
        ("smooth.tendon_bias", "m d qfrc"),
        (
            "collision_core.contact_params",
            "geom_condim geom_priority geom_solmix geom_solref geom_solimp geom_friction geom_margin geom_gap "
            "geom_adhesion pair_dim pair_solref pair_solreffriction pair_solimp pair_margin pair_gap pair_adhesion "
            "pair_friction collision_pair_in collision_pairid_in cid worldid",
        ),
        (
            "collision_core.write_contact",
            "naconmax_in id_ dist_in pos_in frame_in margin_in gap_in condim_in friction_in solref_in "
            "solreffriction_in solimp_in adhesion_in geoms_in pairid_in worldid_in contact_dist_out contact_pos_out "
            "contact_frame_out contact_includemargin_out contact_friction_out contact_solref_out "
            "contact_solreffriction_out contact_solimp_out contact_dim_out contact_geom_out contact_efc_address_out "
            "contact_worldid_out contact_type_out contact_geomcollisionid_out contact_adhesion_out nacon_out",
        ),
        (
            "collision_driver._contact_surfacevel",
            "geom_surfacevel geom_xpos_in geom_xmat_in contact_pos_in contact_frame_in contact_geom_in "
            "contact_worldid_in naconmax_in nacon_in contact_surfacevel_out",
        ),
    ],
)
def test_functions_take_the_same_arguments(name: str, arguments: str) -> None:
    module, function = name.split(".")
    found = getattr(import_module(f"mujoco_warp._src.{module}"), function, None)
    assert found is not None, f"mujoco_warp._src.{name} is gone"
    present = inspect.signature(getattr(found, "func", found)).parameters
    assert " ".join(present) == arguments, f"mujoco_warp._src.{name} takes other arguments"


@pytest.mark.parametrize(
    ("owner", "names"),
    [
        (
            mjw.Model,
            "nxn_geom_pair nxn_geom_pair_filtered nxn_pairid nxn_pairid_filtered geom_pair_type_count",
        ),
        (
            mjw.Model,
            "callback flg_surfacevel M_hinit_i M_colind nsensorcollision nsensortaxel nrangefinder",
        ),
        (
            mjw.Model,
            "sensor_pos_adr sensor_vel_adr sensor_limitpos_adr sensor_limitvel_adr sensor_contact_pos_adr "
            "sensor_contact_vel_adr sensor_stage_pos_adr sensor_stage_vel_adr sensor_subtree_vel "
            "sensor_rne_postconstraint",
        ),
        (
            mjw.Option,
            "run_qacc_smooth warn_overflow deterministic graph_conditional impratio_invsqrt ls_tolerance",
        ),
        (mjw.Callback, "contactfilter control"),
        (mjw.Constraint, "type id J_rownnz J_rowadr J_colind J D aref frictionloss Ma force state"),
        (
            mjw.Data,
            "naconmax njmax nacon ncollision nefc ne nf overflow solver_niter moment_rownnz moment_rowadr",
        ),
        (
            mjw.RenderContext,
            "hfield_bvh_id hfield_bounds_size hfield_registry rgb_data depth_data seg_data",
        ),
    ],
)
def test_fields_have_the_same_names(owner: type, names: str) -> None:
    fields = {field.name for field in dataclasses.fields(owner)} | set(vars(owner))
    assert not set(names.split()) - fields, f"{owner.__name__} has lost fields"


def test_a_model_says_which_of_its_fields_may_differ_between_worlds(warp_model: mjw.Model) -> None:
    names = upstream.per_world_fields()
    assert {"body_mass", "geom_dataid", "dof_armature"} <= set(
        names
    ) and "geom_type" not in names, "the annotations of mujoco_warp.Model changed"
    with wp.ScopedDevice("cpu"):
        mjw.put_model(mujoco.MjModel.from_xml_string(MODEL), batch_sizes=dict.fromkeys(names, 2))
    assert getattr(warp_model.opt.gravity, "_is_batched", False), (
        "MuJoCo Warp marks batched arrays otherwise"
    )


def test_the_flag_that_lets_boxes_collide_as_in_c_does_nothing_else() -> None:
    folder = Path(import_module("mujoco_warp").__file__ or "").parent / "_src"
    heed = {
        path.stem
        for path in folder.glob("*.py")
        if re.search(r"^[^#]*DisableBit\.NATIVECCD", path.read_text(), re.M)
    }
    assert {name for name in heed if not name.endswith("_test")} == {"collision_driver"}


def test_pairs_are_numbered_as_before(warp_model: mjw.Model) -> None:
    pairs, pair_ids = upstream.geom_pairs(warp_model)
    assert pairs.tolist() == [[0, 1], [0, 2], [1, 2]], "Model.nxn_geom_pair is ordered otherwise"
    assert pair_ids.tolist() == [[-1, -1], [-1, -1], [-2, -1]], (
        "the ids of Model.nxn_pairid changed"
    )
    kept = warp_model.geom_pair_type_count
    upstream.drop_contacts(warp_model, pairs[:, 1] == -1)
    assert warp_model.geom_pair_type_count == kept, "Model.geom_pair_type_count counts otherwise"


def test_set_const_reads_no_data_for_fixed_constants(warp_model: mjw.Model) -> None:
    with wp.ScopedDevice("cpu"):
        upstream.set_fixed_constants(warp_model)


# Our step repeats theirs with another solver, and our solver repeats theirs in one kernel.
@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("forward.step", "24131cb31922"),
        ("forward._forward", "206202eecc88"),
        ("solver._linesearch_iterative_kernel", "742b29a09c5a"),
        ("solver._solve_done", "f691f485dcca"),
    ],
)
def test_what_we_repeat_has_not_changed(name: str, digest: str) -> None:
    module, function = name.split(".")
    repeated = getattr(import_module(f"mujoco_warp._src.{module}"), function)
    found = hashlib.sha256(inspect.getsource(inspect.unwrap(repeated)).encode()).hexdigest()[:12]
    assert found == digest, (
        f"mujoco_warp._src.{name} changed: compare ksim_rl/physics/newton with it, then set {found}"
    )


def test_private_modules_are_used_in_upstream_only() -> None:
    private = re.compile(
        r"^[^#]*(\b(mujoco_warp|warp|mujoco|wp|mjw)\._[a-z]|\btorch\._C|_is_batched)", re.MULTILINE
    )
    users = {
        path.relative_to(ROOT).as_posix()
        for room in ("physics", "device")
        for path in (ROOT / "ksim_rl" / room).rglob("*.py")
        if private.search(path.read_text())
    }
    assert users == {"ksim_rl/physics/upstream.py", "ksim_rl/device/upstream.py"}


@pytest.mark.parametrize("package", ["torch", "mujoco", "mujoco-warp", "warp-lang"])
def test_versions_are_bounded_above(package: str) -> None:
    (found,) = re.findall(
        rf'^  "{package}>=[\d.]+,<([\d.]+)",', (ROOT / "pyproject.toml").read_text(), re.MULTILINE
    )
    present = tuple(int(part) for part in metadata.version(package).split("+")[0].split(".")[:2])
    assert present < tuple(int(part) for part in found.split(".")), (
        f"{package} {present} is beyond {found}"
    )


@pytest.mark.parametrize(
    ("integrator", "sleeps"),
    [
        ("euler", True),
        ("implicit", False),
        ("implicitfast", False),
        ("discrete", False),
        *(
            pytest.param(*pair, marks=pytest.mark.full)
            for pair in (
                ("euler", False),
                ("implicit", True),
                ("implicitfast", True),
                ("discrete", True),
            )
        ),
    ],
)
def test_a_step_does_without_the_arrays_that_are_dropped(integrator: str, sleeps: bool) -> None:
    mj_model = mujoco.MjModel.from_xml_string(MODEL.replace('pos="0 0 1"', 'pos="0 0 0.09"'))
    mj_model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    mj_model.opt.enableflags |= sleeps * mujoco.mjtEnableBit.mjENBL_SLEEP
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(mj_model)
        whole, less = (mjw.make_data(mj_model, nworld=2, nconmax=32, njmax=128) for _ in range(2))
        upstream.drop_unread(m, less)
        assert (less.qH.size == 0) == (integrator != "discrete")
        assert (less.qLU.size == 0) == (integrator != "implicit")
        assert (less.efc_islandid.size == 0) == (not sleeps)
        for data in (whole, less):
            for _ in range(3):
                mjw.step(m, data)
            assert data.nacon.numpy()[0] > 0
            mjw.reset_data(m, data, reset=wp.array([False, True], dtype=bool))
            mjw.step(m, data)
    assert (whole.qpos.numpy() == less.qpos.numpy()).all()
