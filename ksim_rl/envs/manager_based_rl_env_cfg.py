"""Configures `ManagerBasedRlEnv`: one dataclass tree, in Python, YAML and Hydra alike."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from ksim_rl.checked import Checked, NonNegative, Repeats, Within
from ksim_rl.envs.managers.replaced_fields import check_one_writer
from ksim_rl.envs.term import (
    ActionTerm,
    CommandTerm,
    CurriculumTerm,
    EventTerm,
    MetricTerm,
    RewardTerm,
    TerminationTerm,
)
from ksim_rl.physics import SimCfg
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg
from ksim_rl.transforms.transform_cfg import TransformCfg

Seed = Annotated[int, Within(low=0, high=2**63 - 1)] | None


@dataclass(frozen=True, kw_only=True)
class ManagerBasedRlEnvCfg(Checked):
    """The parts of an env: terms by name; action terms take their columns of `"action"` in the order of the mapping.

    The env emits each observation term once as `("obs", term)`, clean; `envs.make` compiles the groups into transforms
    that add noise, delay and history and write one vector per group. It appends `transforms` to these, in this order:
    outputs of the env pass them from the first to the last, and actions from the last to the first.
    """

    decimation: Repeats  # physics substeps per env step
    scene: SceneCfg
    observations: Mapping[str, ObservationGroupCfg] = field(default_factory=dict)  # by group
    actions: Mapping[str, ActionTerm] = field(default_factory=dict)  # what a policy controls
    events: Mapping[str, EventTerm] | None = None  # `ResetToDefault`; {}: the default state
    seed: Seed = None  # None draws one; the env stores the seed that it used in its own `cfg`
    sim: SimCfg = field(default_factory=SimCfg)
    viewer: ViewerCfg = field(default_factory=ViewerCfg)  # the camera of `render()`
    episode_length_s: NonNegative = 0.0  # 0: no episode ends by time, and no term may be a time-out
    rewards: Mapping[str, RewardTerm] = field(default_factory=dict)  # weight 0: not computed
    terminations: Mapping[str, TerminationTerm] = field(default_factory=dict)  # and NaN
    commands: Mapping[str, CommandTerm] = field(default_factory=dict)  # ("command", name)
    curriculum: Mapping[str, CurriculumTerm] = field(default_factory=dict)  # what gets harder
    metrics: Mapping[str, MetricTerm] = field(default_factory=dict)  # logged, not learned from
    is_finite_horizon: bool = False  # True: a time-out is `terminated`, not bootstrapped
    scale_rewards_by_dt: bool = True  # rewards are per second, times the env step, s
    transforms: Mapping[str, TransformCfg] = field(default_factory=dict)  # after the groups

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.viewer.env_index >= self.scene.num_envs:
            raise ValueError(
                f"viewer.env_index={self.viewer.env_index}: expected less than scene.num_envs={self.scene.num_envs}"
            )
        # Without a length a time-out never comes, which is a mistake of the config.
        timed = [name for name, term in self.terminations.items() if term.time_out]
        if timed and self.episode_length_s == 0.0:
            raise ValueError(
                f"episode_length_s=0.0 with the time-out termination {timed[0]!r}: give a positive length, or remove "
                "the termination"
            )
        check_one_writer(self.curriculum)
        shared: dict[str, object] = {}
        for group_name, group in self.observations.items():
            for term_name, term_cfg in group.terms.items():
                # The env emits each term once, by name, so two groups cannot mean two things by one name.
                if shared.setdefault(term_name, term_cfg.term) != term_cfg.term:
                    raise ValueError(
                        f"observations.{group_name}.terms.{term_name}: another group has a different term of this "
                        "name; groups share each term, so rename one of them"
                    )
