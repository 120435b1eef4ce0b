"""This module configures `ManagerBasedRlEnv`: one dataclass tree, in Python, YAML and Hydra alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ksim_rl.checks import check_in_range
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


@dataclass(frozen=True, kw_only=True)
class ManagerBasedRlEnvCfg:
    """What an env is made of.

    Attributes:
        decimation: physics substeps per env step.
        scene: robots, terrain, sensors, `num_envs`, spacing.
        observations: groups of terms. The env emits each term once as `("obs", term)`, clean; `envs.make` compiles the
            groups into transforms that add noise, delay and history and write one vector per group.
        actions: terms; each takes its columns of `"action"`, in this order.
        events: resets, randomization, pushes. None resets to the model's first keyframe or, without one, to its
            default pose; `{}` leaves a reset row at MuJoCo's `qpos0`.
        seed: None draws one; the env stores the seed that it used in its own `cfg`.
        sim: physics options; None in a field keeps the model's own.
        viewer: the camera of `render()`.
        episode_length_s: s; 0 means that episodes never end by time, and goes without a time-out termination.
        rewards: weighted terms; a term of weight 0 is not computed.
        terminations: terms; `time_out=True` marks truncation. Empty: only non-finite physics ends an episode.
        commands: generators with resampling clocks; emitted as `("command", name)`.
        curriculum: terms that adapt difficulty.
        metrics: values per step that are reduced over the episode.
        is_finite_horizon: False: a time-out is `truncated`, and its value is bootstrapped; True: it is `terminated`.
        scale_rewards_by_dt: True: rewards are per second and are multiplied by the env step's seconds.
        transforms: what `envs.make` appends, in this order, to the transforms of the groups. What the env emits passes
            them from the first to the last, and an action from the last to the first.
    """

    decimation: int
    scene: SceneCfg
    observations: Mapping[str, ObservationGroupCfg]
    actions: Mapping[str, ActionTerm]
    events: Mapping[str, EventTerm] | None = None
    seed: int | None = None
    sim: SimCfg = field(default_factory=SimCfg)
    viewer: ViewerCfg = field(default_factory=ViewerCfg)
    episode_length_s: float = 0.0
    rewards: Mapping[str, RewardTerm] = field(default_factory=dict)
    terminations: Mapping[str, TerminationTerm] = field(default_factory=dict)
    commands: Mapping[str, CommandTerm] = field(default_factory=dict)
    curriculum: Mapping[str, CurriculumTerm] = field(default_factory=dict)
    metrics: Mapping[str, MetricTerm] = field(default_factory=dict)
    is_finite_horizon: bool = False
    scale_rewards_by_dt: bool = True
    transforms: Mapping[str, TransformCfg] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.decimation, bool) or not isinstance(self.decimation, int) or self.decimation < 1:
            raise ValueError(f"decimation={self.decimation!r}: expected a whole number of at least 1")
        check_in_range("episode_length_s", self.episode_length_s, low=0.0)
        if self.seed is not None:
            check_in_range("seed", self.seed, low=0, high=2**63 - 1)
        if self.viewer.env_index >= self.scene.num_envs:
            raise ValueError(
                f"viewer.env_index={self.viewer.env_index}: expected less than scene.num_envs={self.scene.num_envs}"
            )
        if not self.actions:
            raise ValueError("actions={}: name at least one action term")
        for name, transform in self.transforms.items():
            if not isinstance(transform, TransformCfg):
                raise ValueError(
                    f"transforms.{name}={transform!r}: each env builds its own, so give "
                    "TransformCfg(<class>, <arguments>)"
                )
        timed = [name for name, term in self.terminations.items() if term.time_out]
        if timed and self.episode_length_s == 0.0:
            raise ValueError(
                f"episode_length_s=0.0 with the time-out termination {timed[0]!r}: give a positive length, or remove "
                "the termination"
            )
        shared: dict[str, object] = {}
        for group_name, group in self.observations.items():
            for term_name, term_cfg in group.terms.items():
                if shared.setdefault(term_name, term_cfg.term) != term_cfg.term:
                    raise ValueError(
                        f"observations.{group_name}.terms.{term_name}: another group has a different term of this "
                        "name; groups share each term, so rename one of them"
                    )
