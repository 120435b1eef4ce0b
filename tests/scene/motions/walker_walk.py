"""Eight seconds of walking for the planar walker, from inverse kinematics of the legs.

The torso moves at a constant speed and nods up and down twice per stride. Each foot stays flat: it rests on the ground
for the stance, then swings forward along a cycloid. The legs are half a stride apart.
"""

import math
from pathlib import Path

import numpy as np

from ksim_rl.scene.motions import motion
from ksim_rl.scene.robots.control_models import Walker

FPS = 50
DURATION_S = 8.0
SPEED = 0.8
STRIDE_S = 1.0
STANCE = 0.6
"""Share of the stride that a foot is on the ground."""
HIP_HEIGHT, HIP_RISE = 0.9, 0.01
PITCH = 0.05
LIFT = 0.08
THIGH, SHIN, ANKLE_HEIGHT = 0.42, 0.44, 0.101
"""m, of `walker.xml`; the ankle's height has 1 mm of air below the foot."""
HIP_BELOW_TORSO = 0.28


def walk() -> dict[str, np.ndarray]:
    """Return the arrays of the .npz file: fps, qpos [F, nq], qvel [F, nv] and the names of the joints."""
    model = Walker().spec().compile()
    time_F = np.arange(round(DURATION_S * FPS) + 1) / FPS
    column = {model.joint(i).name: int(model.jnt_qposadr[i]) for i in range(model.njnt)}
    qpos_FL = np.zeros((len(time_F), model.nq))

    hip_x = SPEED * time_F
    hip_z = HIP_HEIGHT + HIP_RISE * np.cos(4.0 * math.pi * time_F / STRIDE_S)
    # "root_x" and "root_z" are of the torso's middle, which leans over the hips.
    qpos_FL[:, column["root_x"]] = hip_x + HIP_BELOW_TORSO * math.sin(PITCH)
    qpos_FL[:, column["root_z"]] = hip_z + HIP_BELOW_TORSO * math.cos(PITCH)
    qpos_FL[:, column["root_y"]] = PITCH
    for side, lead in (("right", 0.0), ("left", 0.5)):
        forward, height = _ankle((time_F / STRIDE_S + lead) % 1.0)
        thigh, knee = _leg(forward, height - hip_z)
        qpos_FL[:, column[f"{side}_hip"]] = thigh - PITCH
        qpos_FL[:, column[f"{side}_knee"]] = knee
        qpos_FL[:, column[f"{side}_ankle"]] = -thigh - knee

    return {
        "fps": np.array(float(FPS)),
        "qpos": qpos_FL.astype(np.float32),
        "qvel": np.asarray(np.gradient(qpos_FL, 1.0 / FPS, axis=0), dtype=np.float32),
        "joint_names": np.array(list(column)),
    }


def _ankle(phase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the ankle is at a phase in [0, 1) of its stride: m ahead of the hip, and m above the ground."""
    half = SPEED * STRIDE_S * STANCE / 2.0
    swing = np.clip((phase - STANCE) / (1.0 - STANCE), 0.0, 1.0)
    # Over the ground the foot stands, then covers a whole stride; the hip moves on all the time.
    over_ground = SPEED * STRIDE_S * (swing - np.sin(2.0 * math.pi * swing) / (2.0 * math.pi))
    forward = half + over_ground - SPEED * STRIDE_S * phase
    return forward, ANKLE_HEIGHT + LIFT * (1.0 - np.cos(2.0 * math.pi * swing)) / 2.0


def _leg(forward: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the thigh's angle from straight down and the knee's, rad, that put the ankle there, seen from the hip.

    Angles turn about y: a positive one moves what hangs down backward.
    """
    reach = np.hypot(forward, up)
    knee = np.arccos((reach**2 - THIGH**2 - SHIN**2) / (2.0 * THIGH * SHIN))
    thigh = np.arctan2(-forward, -up) - np.arctan2(SHIN * np.sin(knee), THIGH + SHIN * np.cos(knee))
    return thigh, knee


def main() -> None:
    """Write the file into the package: `python -m tests.scene.motions.walker_walk`."""
    np.savez_compressed(Path(motion.__file__).with_name("walker_walk.npz"), **walk())


if __name__ == "__main__":
    main()
