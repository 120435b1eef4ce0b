"""This package has one manager per kind of term: it runs the terms in their scopes and keeps their clocks and sums."""

from ksim_rl.envs.managers.action_manager import ActionManager
from ksim_rl.envs.managers.command_manager import CommandManager
from ksim_rl.envs.managers.curriculum_manager import CurriculumManager
from ksim_rl.envs.managers.episode_log import EpisodeLog
from ksim_rl.envs.managers.event_manager import EventManager
from ksim_rl.envs.managers.metric_manager import MetricManager
from ksim_rl.envs.managers.observation_manager import ObservationManager
from ksim_rl.envs.managers.reward_manager import RewardManager
from ksim_rl.envs.managers.termination_manager import TerminationManager

__all__ = [
    "ActionManager",
    "CommandManager",
    "CurriculumManager",
    "EpisodeLog",
    "EventManager",
    "MetricManager",
    "ObservationManager",
    "RewardManager",
    "TerminationManager",
]
