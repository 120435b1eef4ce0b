"""Reference motions that come with the package lie here, each an .npz file that `view.motion(name)` reads."""

from ksim_rl.scene.motions.motion import ReferenceMotion, load_motion, motion_path
from ksim_rl.scene.motions.motion_set import MotionSet

__all__ = ["MotionSet", "ReferenceMotion", "load_motion", "motion_path"]
