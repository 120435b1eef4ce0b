"""These actions move a site of the robot through space; inverse kinematics finds the targets of its joints."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive, Range
from ksim_rl.checks import check_known
from ksim_rl.envs.term import ActionTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.small_matrices import product, solved
from ksim_rl.transforms.elementwise import clipped

PLACE = ("x", "y", "z")
TURN = ("about x", "about y", "about z")


def jacobian(view: EnvView, site: str, joints: Patterns) -> Float[Tensor, "E 6 K"]:
    """Return how a site moves (m) and turns (rad), world frame, per unit of each joint; position stage.

    The first three rows are of its position, the others of its orientation; joints that do not carry it have zeros.
    """
    model = view.world.mj_model
    chosen = view.joints(joints)
    body = int(model.site_bodyid[view.site(site).id])
    # Motions of degrees of freedom about the centre of mass of the tree: angular, then linear, world axes.
    world = view.derived()
    cdof_EK6 = world.view("cdof")[:, chosen.qvel]
    lever_E13 = (view.site(site).pos_EL - world.subtree_com_EL[:, int(model.body_rootid[body])])[
        :, None
    ]
    turn_EK3 = cdof_EK6[..., :3]
    move_EK3 = cdof_EK6[..., 3:] + torch.linalg.cross(turn_EK3, lever_E13.expand_as(turn_EK3))
    carries_K = constant(_carrying(view, site, joints), view.device)
    return (torch.cat((move_EK3, turn_EK3), dim=-1) * carries_K[:, None]).mT


def _carrying(view: EnvView, site: str, joints: Patterns) -> tuple[float, ...]:
    """Return 1 for each joint between the site and the world, else 0."""
    model = view.world.mj_model
    body = int(model.site_bodyid[view.site(site).id])
    above = set()
    while body:
        above.add(body)
        body = int(model.body_parentid[body])
    names = view.joints(joints).names
    return tuple(float(int(model.joint(name).bodyid[0]) in above) for name in names)


@dataclass(frozen=True, kw_only=True)
class DifferentialIKAction(ActionTerm):
    """Joint position targets by which a site moves as the action says, by damped least squares (differential IK).

    The action has x, y, z of a displacement, world frame, and with `turns` a rotation vector besides; the targets move
    by J^T (J J^T + damping^2 I)^-1 dx, with J the site's Jacobian when the env step begins (Wampler, IEEE Transactions
    on Systems, Man, and Cybernetics 16(1), 1986). Where J loses rank, the damping keeps the joints slow: they reach
    less than was asked for. Targets go on from the targets before, so that a servo that sags under a load does not sink
    with each step; an episode starts where the encoders read. What the site does not ask for may bring the joints
    towards the default pose.

    Attributes:
        joints: they carry the site; others among them do not move.
        scale, turn_scale: m, and rad, per unit action.
        damping: of the least squares, m; errors of turns count as if a rad were a metre.
        max_lead: rad or m, the most that a target is away from its joint's reading.
        posture_weight: the share of the way to the default pose that joints go in each env step, in directions that do
            not move the site.
        clip: of the raw action.
    """

    joints: Patterns
    site: str
    scale: Positive = 0.05
    turns: bool = False
    turn_scale: Positive = 0.2
    damping: Positive = 0.05
    max_lead: Positive = 0.5
    posture_weight: NonNegative = 0.0
    clip: Range | None = None

    def size(self, view: EnvView) -> int:
        """Return 3, or 6 with turns."""
        check_known("site", self.site, view.resolver.names("site"))
        if not any(_carrying(view, self.site, self.joints)):
            raise ValueError(
                f"joints={self.joints!r}: none of them carries site={self.site!r}, so that it cannot be moved: name "
                "joints between the site and the base"
            )
        # Read in construction, so that the engines compute it.
        jacobian(view, self.site, self.joints)
        return len(self.columns())

    def columns(self) -> tuple[str, ...]:
        """Return what each column of the action means."""
        if self.turns:
            return (*PLACE, *TURN)
        return PLACE

    def bounds(self, view: EnvView) -> Float[Tensor, "K 2"] | None:
        if self.clip is None:
            return None
        return constant(self.clip, view.device).expand(len(self.columns()), 2)

    def step(
        self, view: EnvView, action_EK: Float[Tensor, "E K"], target_EN: Float[Tensor, "E N"]
    ) -> Float[Tensor, "E N"]:
        """Return by how much the target of each joint is to move, rad or m."""
        if self.clip is not None:
            action_EK = clipped(action_EK, self.clip)
        count = len(self.columns())
        scales = (*(self.scale,) * 3, *(self.turn_scale,) * 3)[:count]
        asked_EK = action_EK * constant(scales, view.device)
        jacobian_EKN = jacobian(view, self.site, self.joints)[:, :count]
        unit_KK = torch.eye(count, device=view.device)
        gram_EKK = product(jacobian_EKN, jacobian_EKN.mT) + self.damping**2 * unit_KK
        if self.posture_weight == 0.0:
            return _transposed(jacobian_EKN, solved(gram_EKK, asked_EK))
        home_EN = self.posture_weight * (view.joints(self.joints).default_pos_EL - target_EN)
        # The way home moves the site as well, which the least squares take back: what is left of it lies in the null
        # space of the Jacobian.
        moves_EK = product(jacobian_EKN, home_EN[..., None])[..., 0]
        return home_EN + _transposed(jacobian_EKN, solved(gram_EKK, asked_EK - moves_EK))

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        joints = view.joints(self.joints)
        now_EN = joints.encoder_pos_EL
        kept_EN = view.buffer("target_EN", len(joints))
        has_begun_E = view.buffer("has_begun_E")
        # A reset has zeroed the buffers; zero is no target.
        target_EN = torch.where(has_begun_E[:, None] > 0, kept_EN, now_EN)
        has_begun_E.fill_(1.0)
        asked_EN = target_EN + self.step(view, action_EK, target_EN)
        # A site that something holds back must not wind its targets up.
        asked_EN = asked_EN.clamp(now_EN - self.max_lead, now_EN + self.max_lead)
        low_N, high_N = joints.soft_limits_L2.unbind(-1)
        asked_EN = torch.clamp(asked_EN, low_N, high_N)
        kept_EN.copy_(asked_EN)
        view.write_joint_pos_target(self.joints, asked_EN)


def _transposed(jacobian_EKN: Tensor, value_EK: Tensor) -> Tensor:
    return product(jacobian_EKN.mT, value_EK[..., None])[..., 0]
