"""The models of the DeepMind Control Suite, from the MJCF files of the package `dm_control`."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import mujoco

from ksim_rl.checked import Checked, NonNegative
from ksim_rl.checks import unknown_name
from ksim_rl.physics import load_spec
from ksim_rl.suites.foreign_models import HIDDEN_GROUP, package_folder

Variant = Literal["dm_control", "playground"]
NUM_SWIMMER_LINKS = 6


@dataclass(frozen=True, kw_only=True)
class DmControlModel(Checked):
    """A domain's model, such as "cheetah", as the package `dm_control` has it, or as MuJoCo Playground changes it.

    Both lose the flag "energy", which changes no motion and costs the one-kernel solver. A target that each episode
    places again is a command of the task, so that the model's own is hidden. `damping` replaces the damping of joints.

    Raises:
        ValueError: where the package is missing, with the command that installs it.
    """

    domain: str
    variant: Variant = "dm_control"
    damping: Mapping[str, NonNegative] = field(default_factory=dict)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        folder = package_folder(
            "dm_control", of="the tasks of the DeepMind Control Suite", extra="dm_control"
        )
        spec = load_spec(folder / "suite" / f"{self.domain}.xml")
        # All other flags stay as the file has them.
        spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        if self.domain == "swimmer":
            _add_links(spec, NUM_SWIMMER_LINKS)
        # The task's command draws its target itself.
        for element in (*spec.geoms, *spec.sites):
            if element.name == "target" and self.domain in ("finger", "fish", "reacher", "swimmer"):
                element.group = HIDDEN_GROUP
        joints = {joint.name: joint for joint in spec.joints}
        for name, damping in self.damping.items():
            if name not in joints:
                raise unknown_name("joint", name, joints)
            # MuJoCo keeps three coefficients; only the linear one is set.
            joints[name].damping = [damping, 0.0, 0.0]
        # Last, since it changes the finished model.
        if self.variant == "playground":
            _change(spec, self.domain)
        return spec


def _add_links(spec: mujoco.MjSpec, count: int) -> None:
    """Hang the links of a swimmer behind its head, each with a motor and with sensors of its velocities.

    The file has the head alone; dm_control's `swimmer.py` makes and describes the rest.
    """
    parent = spec.body("head")
    defaults = {name: spec.find_default(name) for name in ("swimmer", "visual", "inertial")}
    # The head is the first of `count` links.
    for index in range(count - 1):
        # Each link hangs 0.1 m from the one before it.
        parent = parent.add_body(name=f"segment_{index}", pos=[0.0, 0.1, 0.0])
        for kind in ("visual", "inertial"):
            parent.add_geom(defaults[kind], name=f"{kind}_{index}")
        site = parent.add_site(defaults["swimmer"], name=f"site_{index}")
        # Together the joints can bend the chain into about a circle.
        limit = 2.0 * math.pi / count
        # Degrees, as in the file, which the compiler turns into radians.
        if spec.compiler.degree:
            limits = [-math.degrees(limit), math.degrees(limit)]
        else:
            limits = [-limit, limit]
        joint = parent.add_joint(defaults["swimmer"], name=f"joint_{index}", range=limits)
        motor = spec.add_actuator(spec.default, name=f"motor_{index}", target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        for name, kind in (
            ("velocimeter", mujoco.mjtSensor.mjSENS_VELOCIMETER),
            ("gyro", mujoco.mjtSensor.mjSENS_GYRO),
        ):
            spec.add_sensor(
                name=f"{name}_{index}",
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=site.name,
            )


def _change(spec: mujoco.MjSpec, domain: str) -> None:
    """Make the changes of MuJoCo Playground's copies of the files that no option of `SimCfg` makes."""
    # Playground's integrator treats damping explicitly.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    geoms = {geom.name: geom for geom in spec.geoms}
    if domain == "finger":
        for name in ("proximal_decoration", "spinner_decoration"):
            # Decorations collide with nothing there.
            geoms[name].contype = geoms[name].conaffinity = 0
    if domain == "fish":
        # A ball in place of the file's shape.
        geoms["torso_massive"].type = mujoco.mjtGeom.mjGEOM_SPHERE
        geoms["torso_massive"].size = [0.03, 0.0, 0.0]
