"""Reports contacts and constraints that did not fit, from sticky bits and maxima read once per rollout."""

import dataclasses
import math
from collections.abc import Sequence

import mujoco_warp as mjw
import torch
import warp as wp
from jaxtyping import Int
from torch import Tensor

from ksim_rl.physics import native

# The solver stopping at its iteration limit is a setting, not a loss of contacts.
METRIC_BITS = ("ITERATIONS", "LS_ITERATIONS")
# The bits that kernels of ours set, by their names in C++.
OUT_OF = {
    "OUT_OF_ROWS": int(mjw.OverflowType.NEFC),
    "OUT_OF_PAIRS": int(mjw.OverflowType.BROADPHASE),
    "OUT_OF_CONTACTS": int(mjw.OverflowType.NARROWPHASE),
}
# The bits of too small an njmax, and of too small an nconmax.
OF_ROWS = ("NEFC", "NJMAX_NNZ")
OF_POOL = ("BROADPHASE", "NARROWPHASE", "CCD")
# In the order of the bits, lowest first.
BIT_NAMES = tuple(
    name for name, bit in mjw.OverflowType.__members__.items() if bit and bit & (bit - 1) == 0
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OverflowReport:
    """How much room the physics needed since the last report, and how much there is.

    `worlds` counts those that raised each overflow bit. Of all substeps, `nefc` is the most constraint rows of any
    world, which has `njmax`, and `ncon` the most contacts or candidate pairs in the pool of all worlds, which has
    `naconmax` places.
    """

    worlds: dict[str, int]
    nefc: int
    njmax: int
    ncon: int
    naconmax: int
    num_envs: int

    @property
    def ok(self) -> bool:
        """Whether no contact and no constraint was lost."""
        return not self.messages

    @property
    def lost_worlds(self) -> int:
        """How many worlds have lost contacts or constraints, at least: the most that lost one kind of them."""
        counts = [count for name, count in self.worlds.items() if name not in METRIC_BITS]
        return max(counts, default=0)

    @property
    def nconmax(self) -> int:
        """Places in the pool of contacts, per world."""
        return self.naconmax // self.num_envs

    @property
    def messages(self) -> tuple[str, ...]:
        """One for each kind of loss, naming the needed and the present value."""
        needed_nconmax = math.ceil(self.ncon / self.num_envs)
        pool = (
            f"the pool of contacts and candidate pairs needed {self.ncon} places but has {self.naconmax}: "
            f"set sim.nconmax >= {needed_nconmax} (now {self.nconmax} per world, {self.num_envs} worlds)"
        )
        known = {
            "NEFC": f"constraint rows needed {self.nefc} per world but has {self.njmax}: "
            f"set sim.njmax >= {self.nefc}",
            "NJMAX_NNZ": f"the constraint Jacobian is full; it grows with njmax: raise sim.njmax above {self.njmax}",
            "BROADPHASE": pool,
            "NARROWPHASE": pool,
            "CCD": f"too many convex pairs: raise sim.nconmax above {self.nconmax}",
            "HFIELD": "too many height-field cells under one geom: use smaller geoms or a coarser height field",
            "CONTACT_MATCH": "a contact sensor matched more contacts than it keeps: "
            'raise <custom><numeric name="contact_sensor_maxmatch" data="64"/></custom> in the model',
            "EPA_HORIZON": "convex collision ran out of faces: simplify the meshes or raise sim.ccd_iterations",
            "TACTILE": "a tactile sensor saw more geoms than it keeps",
            "NVMAX": "too many degrees of freedom are awake",
        }
        lines: dict[str, list[str]] = {}
        for name, count in self.worlds.items():
            if count and name not in METRIC_BITS:
                text = known.get(name, "the physics dropped something")
                lines.setdefault(text, []).append(f"{name} in {count} worlds")
        return tuple(f"{text} ({', '.join(bits)})" for text, bits in lines.items())

    @property
    def metrics(self) -> dict[str, float]:
        """Shares in [0, 1] and counts to log."""
        return {
            "nefc_share": self.nefc / self.njmax if self.njmax else 0.0,
            "ncon_share": self.ncon / self.naconmax if self.naconmax else 0.0,
            **{f"{name.lower()}_worlds": self.worlds[name] / self.num_envs for name in METRIC_BITS},
        }


def record_arrays(num_envs: int) -> dict[str, wp.array]:
    """Return arrays of so many worlds in which kernels keep overflow bits and needs."""
    sizes = {"sticky": num_envs, "most_nefc": num_envs, "most_pool": 2}
    return {name: wp.zeros(size, dtype=int) for name, size in sizes.items()}


class OverflowRecord:
    """Sticky overflow bits and running maxima on the device, which `counts` sums up there.

    After each substep, so before any reset clears them, the integration updates its arrays, or `record` launches that.
    """

    def __init__(self, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        self._warp_data_E = warp_data_E
        # One thread for each world.
        if warp_data_E.qpos.device.is_cuda:
            threads = 128
        else:
            threads = 1
        self.arrays = record_arrays(warp_data_E.nworld)
        self.sticky_E, self.most_nefc_E, self.most_pool = map(wp.to_torch, self.arrays.values())
        header = "ksim_rl/physics/smooth/record.cuh"
        self.record = native.launcher_of(
            header, OUT_OF, self.arrays, warp_model, warp_data_E, lanes=1, threads=threads
        )
        if warp_model.opt.integrator == mjw.IntegratorType.RK4:
            # It makes rows four times in a substep, and the last ones alone are there at the end. Callbacks of controls
            # and of passive forces come after the rows, and models may leave out one of the two.
            warp_model.callback.control = warp_model.callback.passive = lambda m, d: self.record()

    def clear(self) -> None:
        """Start the next period. Bits that MuJoCo Warp keeps until a world resets are of the last one, too."""
        # The maxima are zeroed in place: graphs keep their addresses.
        of_worlds_E = wp.to_torch(self._warp_data_E.overflow)
        for tensor in (self.sticky_E, self.most_nefc_E, self.most_pool, of_worlds_E):
            tensor.zero_()

    def counts(self) -> Int[Tensor, " N"]:
        """Return the period in whole numbers on the device: worlds by bit, most rows, most contacts and pairs."""
        bits = torch.arange(len(BIT_NAMES), device=self.sticky_E.device, dtype=torch.int32)
        # A column for each bit, [E, bits], summed over worlds.
        worlds = ((self.sticky_E[:, None] >> bits) & 1).sum(0)
        return torch.cat([worlds, self.most_nefc_E.max().view(1), self.most_pool])

    def explain(self, numbers: Sequence[int]) -> OverflowReport:
        """Make the report of `counts` that were read on the host."""
        d = self._warp_data_E
        worlds = dict(zip(BIT_NAMES, numbers, strict=False))
        nefc = numbers[len(BIT_NAMES)]
        # Contacts and candidate pairs share the pool, which needed room for the larger number.
        ncon = max(numbers[len(BIT_NAMES) + 1 :])
        return OverflowReport(
            worlds=worlds,
            nefc=nefc,
            njmax=d.njmax,
            ncon=ncon,
            naconmax=d.naconmax,
            num_envs=d.nworld,
        )
