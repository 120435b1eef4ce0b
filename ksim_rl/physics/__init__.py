"""This package turns a MuJoCo model into many worlds on the device, and steps, refreshes, resets and watches them."""

from ksim_rl.device import capture
from ksim_rl.device.capture import Captured
from ksim_rl.device.kernel_loading import compile_notice
from ksim_rl.physics import warp_world as warp_world
from ksim_rl.physics.c_engine import c_world as c_world
from ksim_rl.physics.fields import prepare_spec
from ksim_rl.physics.load import load_model, load_spec
from ksim_rl.physics.nan_guard.guard import NanGuardCfg, NanReport
from ksim_rl.physics.overflow import OverflowReport
from ksim_rl.physics.sim_cfg import SimCfg
from ksim_rl.physics.world import World
