"""Learns from mirror images: for robots that are their own, by mirrored samples or by a loss."""

from collections.abc import Callable, Iterable, Mapping

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor

from ksim_rl import dims
from ksim_rl.objectives.masked import mask_of, masked_mean
from ksim_rl.objectives.policy_kl import gaussian_parameters
from ksim_rl.transforms.mirror.mirror import MirrorMap, image

Loss = Callable[[TensorDictBase], TensorDictBase]


class SymmetricAugmentation:
    """Adds to a minibatch its mirror image (Mittal et al., arXiv 2403.04359, section III-B).

    The image of an env state has the mirrored observations, action and distribution of the policy that collected it;
    advantage, value target, state value and log-probability are copied from the env state, as they are the same in
    the mirror: there another policy collected, which is the image of the one that did. `maps` has, by key, all
    observations that the networks `read`, and "action"; a ValueError names those that it lacks. Makes no host sync.
    """

    def __init__(
        self,
        maps: Mapping[NestedKey, MirrorMap] | None,
        *,
        read: Iterable[NestedKey] = (),
        symmetry: str = "augment",
        device: torch.device | str | None = None,
    ) -> None:
        maps = maps or {}
        missing = [key for key in dict.fromkeys([*read, "action"]) if key not in maps]
        if missing:
            raise ValueError(
                f"symmetry={symmetry!r} needs the mirror image of {missing}: add it to the maps"
            )
        device = torch.device("cpu" if device is None else device)
        self._images = {key: mirror.tensors(device) for key, mirror in maps.items()}
        source_L, signs_L = self._images["action"]
        # The mean mirrors as the action does; a standard deviation moves with its joint, but has no sign.
        self._images["loc"] = (source_L, signs_L)
        self._images["scale"] = (source_L, torch.ones_like(signs_L))

    def image_of(
        self, key: NestedKey, leaf_BL: Float[Tensor, "*batch L"]
    ) -> Float[Tensor, "*batch L"]:
        """Return the mirror image of vectors of a kind that has a map."""
        return image(leaf_BL, *self._images[key])

    def image(self, minibatch_B: TensorDictBase) -> TensorDictBase:
        """Return the mirror image of a minibatch; leaves without a map are the same tensors."""
        # A shallow clone: leaves without a map are shared, not copied.
        reflected_B = minibatch_B.clone(recurse=False)
        for key in self._images:
            leaf_BL = minibatch_B.get(key, None)
            if leaf_BL is not None:
                reflected_B.set(key, self.image_of(key, leaf_BL))
        return reflected_B

    def reflect_every_second_(self, minibatch_B: TensorDictBase) -> None:
        """Replace every second env state, and the one that follows it under "next", by its mirror image."""
        # By place in the minibatch: env states are drawn at random, so half of them suffice, without a draw.
        order_B = torch.arange(minibatch_B.batch_size[0], device=minibatch_B.device)
        reflected_B1 = (order_B % 2 == 1)[:, None]
        for part_B in (minibatch_B, minibatch_B.get("next")):
            for key in self._images:
                leaf_BL = part_B.get(key, None)
                if leaf_BL is not None:
                    part_B.set(key, torch.where(reflected_B1, self.image_of(key, leaf_BL), leaf_BL))

    def __call__(self, minibatch_B: TensorDictBase) -> TensorDictBase:
        """Return `minibatch_B` and its image, `["B"]` with twice the size; the first half is the minibatch."""
        # Leaf by leaf: the compiler cannot follow torch.cat of TensorDicts.
        both_B = minibatch_B.apply(
            lambda *leaves: torch.cat(leaves),
            self.image(minibatch_B),
            batch_size=[2 * minibatch_B.batch_size[0]],
        )
        assert both_B is not None
        return dims.name(both_B, dims.B)


def mirror_loss(
    actor: ProbabilisticTensorDictSequential,
    minibatch_B: TensorDictBase,
    mirror: SymmetricAugmentation,
) -> Float[Tensor, ""]:
    """Return the mean squared difference between pi(mirror(s)) and mirror(pi(s)) (Yu et al., arXiv 1801.08093).

    The mean is over env states and actions, in squared units of the action; pi is the mean of the policy's gaussian,
    and the gradient flows through both. (Yu et al. sum over actions.) Masked env states are left out.
    """
    # One pass of the network for both.
    dist = actor.get_dist(mirror(minibatch_B.select(*actor.in_keys)))
    parameters = gaussian_parameters(dist)
    if parameters is None:
        raise ValueError(f"the mirror loss needs a gaussian policy, got {type(dist).__name__}")
    # The first half are the policy's means in the env states, the second in their images, [B, A] each.
    loc_BL, loc_of_image_BL = parameters[0].chunk(2)
    image_of_loc_BL = mirror.image_of("action", loc_BL)
    error_B = (loc_of_image_BL - image_of_loc_BL).square().mean(-1)
    return masked_mean(error_B, mask_of(minibatch_B, error_B))
