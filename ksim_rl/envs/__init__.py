"""The env, its terms, its transforms and its tasks."""

from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.config.plugins import allow_package
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.envs.registry import build, make, make_cfg, names, register_configs, task
from ksim_rl.envs.room import with_room
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import (
    ActionTerm,
    CommandTerm,
    CurriculumTerm,
    EventTerm,
    MetricTerm,
    ObservationTerm,
    RewardTerm,
    TerminationTerm,
)
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.scene import MjcfRobot, Placement, Robot, SceneCfg
from ksim_rl.scene.sensors import (
    CameraSensor,
    ContactPoints,
    ContactSensor,
    GridPattern,
    ImuSensor,
    PinholePattern,
    RayCaster,
    RingPattern,
)
from ksim_rl.scene.state.entity import Entity
from ksim_rl.scene.terrains import PlaneTerrain, TerrainGrid
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.transforms.transform_cfg import TransformCfg
