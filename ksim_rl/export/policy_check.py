"""Compares the ONNX file of a policy with the actor itself, over drawn observations."""

from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.export.picture_inputs import PictureInput
from ksim_rl.export.policy import ExportedPolicy, StateSpec, as_row
from ksim_rl.modules.network import ObservationNormalizer
from ksim_rl.modules.recurrent import RESET_KEY, RecurrentModule

# Greatest error of the ONNX file, and over how many observations it is looked for.
TOLERANCE = 1e-5
CHECKED = 10_000
# Observations in one call, as parallel episodes.
ROWS = 100
# A picture has some thousand numbers, each of which counts.
CHECKED_PICTURES = 1_000


def num_checked(policy: ExportedPolicy) -> int:
    """Return over how many observations a file is compared."""
    if policy.pictures:
        return CHECKED_PICTURES
    return CHECKED


def greatest_difference(policy: ExportedPolicy, path: Path) -> float:
    """Return the greatest difference of an ONNX file's actions from the actor's, over `num_checked` observations.

    It is relative to actions above 1, which float32 holds no better.
    Vectors are drawn about the statistics of the policy's normalizer, in episodes that carry the states. The actor
    itself is asked through TensorDicts, with histories put together here.
    """
    import onnxruntime  # an extra

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    draws = np.random.default_rng(0)
    worst = 0.0
    mean, std = _statistics(policy)
    carried: dict[NestedKey, Tensor] = {}
    states: list[np.ndarray] = []
    frames: list[np.ndarray] = []
    seen: dict[str, list[np.ndarray]] = {picture.name: [] for picture in policy.pictures}
    # Each batch of ROWS is one step of all episodes.
    for step in range(num_checked(policy) // ROWS):
        frames.append(
            (mean + std * draws.standard_normal((ROWS, policy.obs_dim))).astype(np.float32)
        )
        given = {"obs": frames[-1]} if policy.obs_dim else {}
        for picture in policy.pictures:
            seen[picture.name].append(_drawn(picture, draws))
            given[picture.name] = seen[picture.name][-1]
        # States begin with the first frame, as they do on a robot.
        if not step:
            states = [_first(state, given) for state in policy.states]
        feed = dict(zip(policy.input_names, [*given.values(), *states], strict=True))
        actions, *states = (np.asarray(value) for value in session.run(policy.output_names, feed))
        # Recurrent modules clear their state where this is true, at the first step.
        asked = TensorDict({RESET_KEY: torch.full((ROWS, 1), not step)}, batch_size=[ROWS])
        start = 0
        for group, columns in policy.groups.items():
            # Histories are put together from the kept frames, not taken from the states under test.
            terms = []
            for column in columns:
                back = [column.stride * k for k in reversed(range(column.length))]
                terms += [frames[max(step - k, 0)][:, start : start + column.size] for k in back]
                start += column.size
            asked[group] = torch.from_numpy(np.concatenate(terms, -1))
        for picture in policy.pictures:
            asked[picture.group] = _stacked(picture, seen[picture.name])
        # The recurrent state that the actor gave at the step before, zeros at first.
        for part in policy.parts:
            if isinstance(part, RecurrentModule):
                zeros = torch.zeros(ROWS, part.cfg.num_layers, part.cfg.hidden_dim)
                for key in part.state_keys:
                    asked[key] = carried.get(key, zeros)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            answer = policy.actor(asked)
        # TorchRL's modules give the state of the next step under "next".
        carried = {
            key: answer["next", *key]
            for part in policy.parts
            for key in getattr(part, "state_keys", ())
        }
        wanted = torch.cat([as_row(answer[key]) for key in policy.action_keys], -1).numpy()
        # Also where one of the two is NaN, which numpy's `max` passes on, and Python's may not.
        difference = (np.abs(actions - wanted) / np.maximum(np.abs(wanted), 1.0)).max()
        worst = max(worst, float("inf") if np.isnan(difference) else float(difference))
    return worst


def _statistics(policy: ExportedPolicy) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and std of one frame, [L] each; 0 and 1 without a normalizer that covers it."""
    mean = np.zeros(policy.obs_dim)
    std = np.ones(policy.obs_dim)
    for module in policy.actor.modules():
        whole = sum(column.size * column.length for column in policy.columns)
        # The normalizer that covers the whole observation, histories included.
        if isinstance(module, ObservationNormalizer) and module.dim == whole:
            newest = []
            stop = 0
            for column in policy.columns:
                stop += column.size * column.length
                newest += range(stop - column.size, stop)
            mean_L = module.mean.detach().cpu().double()
            std_L = module.var.detach().cpu().double().sqrt()
            mean = mean_L.numpy()[newest]
            # A column that never moved has no spread; it is drawn a little about its mean.
            std = std_L.clamp(min=1e-3).numpy()[newest]
    return mean, std


def _first(state: StateSpec, given: dict[str, np.ndarray]) -> np.ndarray:
    if state.of is None:
        return np.zeros((ROWS, *state.shape), state.dtype)
    frame = given[state.of][:, None]
    if state.columns is not None:
        frame = frame[..., slice(*state.columns)]
    return np.repeat(frame, state.shape[0], 1)


def _drawn(picture: PictureInput, draws: np.random.Generator) -> np.ndarray:
    """Return pictures of noise [ROWS, *shape]."""
    shape = (ROWS, *picture.shape)
    if picture.dtype == torch.uint8:
        return draws.integers(0, 256, shape, np.uint8)
    return draws.uniform(0.0, picture.sensor.max_depth, shape).astype(np.float32)


def _stacked(picture: PictureInput, seen: list[np.ndarray]) -> Tensor:
    """Return the frames that an actor reads, from all pictures that were seen, the newest last."""
    if not picture.is_stacked:
        return torch.from_numpy(seen[-1])
    newest = len(seen) - 1
    back = [picture.stride * k for k in reversed(range(picture.length))]
    return torch.from_numpy(np.stack([seen[max(newest - k, 0)] for k in back], 1))
