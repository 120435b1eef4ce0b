"""Makes zero-copy torch views of Warp arrays, and names those that the next steps of a world depend on."""

import dataclasses
from abc import abstractmethod
from collections.abc import Collection

import mujoco_warp as mjw
import warp as wp
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.checks import check_known

# Left as they were by mujoco_warp.reset_data, though they belong to the episode that ended.
_ACCELERATION_STAGE = (
    "actuator_force qfrc_actuator qfrc_constraint qfrc_passive cacc cfrc_int cfrc_ext"
)
# The arrays that a substep depends on: integrated, or set by the user.
_INPUTS = "time qpos qvel act ctrl qfrc_applied xfrc_applied mocap_pos mocap_quat qacc_warmstart"
# The rest of the state of a world, then results of the last substep that `refresh` does not recompute, but terms may
# read before the next one.
_KEPT = (
    "history plastic eq_active userdata tree_asleep tree_awake body_awake body_awake_ind dof_awake_ind ntree_awake "
    "nbody_awake nv_awake overflow sensordata qacc act_dot actuator_length actuator_velocity"
)
# Arrays that `refresh` recomputes, and arrays that it, or the next last substep, computes once they have been read.
_REFRESHED = (
    "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat subtree_com cdof cinert cvel "
    "cdof_dot ten_J ten_length ten_wrapadr ten_wrapnum wrap_obj wrap_xpos flexvert_xpos flexedge_J flexedge_length"
)
CAMERAS_AND_LIGHTS = frozenset(("cam_xpos", "cam_xmat", "light_xpos", "light_xdir"))
SUBTREE_VELOCITIES = frozenset(("subtree_linvel", "subtree_angmom"))
FORCES_OF_BODIES = frozenset(("cacc", "cfrc_int", "cfrc_ext"))
_ALONE = tuple({name} for name in ("ten_velocity", "M", "qfrc_bias"))
ON_DEMAND_TOGETHER = (CAMERAS_AND_LIGHTS, SUBTREE_VELOCITIES, FORCES_OF_BODIES, *_ALONE)
ON_DEMAND = frozenset().union(*ON_DEMAND_TOGETHER)
ACCELERATION_STAGE = tuple(_ACCELERATION_STAGE.split())
SUBSTEP_INPUTS = tuple(_INPUTS.split())
STATE = (*SUBSTEP_INPUTS, *_KEPT.split(), *ACCELERATION_STAGE)
READABLE = ON_DEMAND.union(STATE, _REFRESHED.split())


def state_tensors(warp_data_E: mjw.Data) -> dict[str, Shaped[Tensor, "*?leaf"]]:
    """Return views of the arrays that make up the state of a world; empty ones are left out."""
    tensors = {name: wp.to_torch(getattr(warp_data_E, name)) for name in STATE}
    return {name: tensor for name, tensor in tensors.items() if tensor.numel()}


def float_rows(warp_data_E: mjw.Data, names: tuple[str, ...]) -> list[wp.array]:
    """Return the named arrays as rows of floats, one per world, on the same memory; without elements, no columns."""
    rows = []
    for name in names:
        tensor = wp.to_torch(getattr(warp_data_E, name))
        # Vectors, quaternions and matrices become single floats.
        width = tensor.numel() // warp_data_E.nworld
        rows.append(wp.from_torch(tensor.reshape(warp_data_E.nworld, width), dtype=wp.float32))
    return rows


def nbytes(warp_data_E: mjw.Data) -> int:
    """Return the memory that all arrays of a Data take, in bytes."""
    return sum(array.capacity for array in arrays(warp_data_E).values())


def arrays(data: object, prefix: str = "") -> dict[str, wp.array]:
    """Return the Warp arrays of a Data by dotted name, its contacts and constraints among them."""
    found: dict[str, wp.array] = {}
    for field in dataclasses.fields(data):  # type: ignore[arg-type]
        value = getattr(data, field.name)
        if isinstance(value, wp.array):
            found[prefix + field.name] = value
        # Contacts and constraints are dataclasses of their own.
        elif dataclasses.is_dataclass(value):
            found |= arrays(value, f"{field.name}.")
    return found


class DataViews:
    """The torch views of a Data, float32, named as MuJoCo names them; they show each change immediately."""

    qpos_EL: Tensor
    qvel_EL: Tensor
    qacc_EL: Tensor
    act_EL: Tensor
    ctrl_EL: Tensor
    sensordata_EL: Tensor
    actuator_force_EL: Tensor
    qfrc_actuator_EL: Tensor
    qfrc_applied_EL: Tensor
    xfrc_applied_EL: Tensor
    xpos_EL: Tensor
    xquat_EL: Tensor
    xmat_EL: Tensor
    xipos_EL: Tensor
    cvel_EL: Tensor
    subtree_com_EL: Tensor
    geom_xpos_EL: Tensor
    geom_xmat_EL: Tensor
    site_xpos_EL: Tensor
    site_xmat_EL: Tensor
    time_E: Tensor

    def show_views(self) -> None:
        """Make the views that are attributes, once the engine has its arrays."""
        self._views: dict[str, Tensor] = {}
        # An attribute such as `qpos_EL` shows the array "qpos".
        for attribute in DataViews.__annotations__:
            setattr(self, attribute, self.view(attribute.rpartition("_")[0]))

    def view(self, name: str) -> Shaped[Tensor, "*shape"]:
        """Return the view of an array of MuJoCo's data, such as "qfrc_constraint", "xquat" or "M".

        Vectors, quaternions (w x y z) and matrices become trailing dims. Arrays that no `refresh` makes current, such
        as "efc.force" or "contact.dist", are refused: see `last_substep`.
        """
        # A stale array would be read in silence.
        if name in self.array_names() and name not in READABLE:
            raise ValueError(
                f"data array {name!r} is what the last substep computed on its way, and nothing refreshes it: read a "
                f"sensor, or last_substep({name!r}) where that moment is meant"
            )
        return self.last_substep(name)

    def last_substep(self, name: str) -> Shaped[Tensor, "*shape"]:
        """Return the view of any array of the engine's data as the last substep left it.

        Rows of `efc` beyond `nefc`, and all of `contact` after a reset, hold leftovers.
        """
        # Views are made once, so that all readers have the same tensor.
        if name not in self._views:
            check_known("data array", name, self.array_names())
            self._views[name] = self.make_view(name)
        return self._views[name]

    @abstractmethod
    def array_names(self) -> Collection[str]:
        """Return the names of all arrays that a view can show."""

    @abstractmethod
    def make_view(self, name: str) -> Shaped[Tensor, "*shape"]:
        """Make the view of an array of that name."""

    def views(self) -> dict[str, Shaped[Tensor, "*?leaf"]]:
        """Return the views made so far, by name."""
        return dict(self._views)

    def drop_views(self) -> None:
        """Forget the views, so that their memory can be freed."""
        self._views.clear()
        for attribute in DataViews.__annotations__.keys() & vars(self).keys():
            delattr(self, attribute)
