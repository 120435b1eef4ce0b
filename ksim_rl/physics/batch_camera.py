"""This module draws one camera of the model for all worlds at once, with MuJoCo Warp's ray-casting renderer."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco_warp as mjw
import torch
import warp as wp
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from ksim_rl.device.streams import warp_scope
from ksim_rl.physics.upstream import add_height_fields
from ksim_rl.physics.world import World


class BatchCamera:
    """Pictures of a camera in each world, as `render` drew them last.

    Args:
        world: the worlds; `refresh` must have run since their state changed.
        camera: name of a camera of the model.
        width, height: pixels.
        rgb, depth, segmentation: what to draw.
        geom_groups: which geoms are visible.
        textures, shadows: drawn or left out; the model's sky counts as a texture.

    Raises:
        ValueError: if the model has no such camera.
    """

    def __init__(
        self,
        world: World,
        camera: str,
        *,
        width: int,
        height: int,
        rgb: bool = True,
        depth: bool = False,
        segmentation: bool = False,
        geom_groups: Sequence[int] = (0, 1, 2),
        textures: bool = True,
        shadows: bool = False,
    ) -> None:
        self._world, self._camera = world, camera
        model, fields = world.mj_model, world.per_world_fields()
        with warp_scope(world.device):
            self._context = mjw.create_render_context(
                model,
                nworld=world.num_envs,
                cam_res=(width, height),
                render_rgb=rgb,
                render_depth=depth,
                render_seg=segmentation,
                use_textures=textures,
                use_shadows=shadows,
                render_skybox=textures,
                enabled_geom_groups=list(geom_groups),
                cam_active=[camera],
                use_precomputed_rays=not {"cam_fovy", "cam_intrinsic"} & fields.keys(),
            )
            if "geom_dataid" in fields:
                add_height_fields(self._context, model)
        self._shape = (world.num_envs, height, width)

    def render(self) -> None:
        """Draw the present state of all worlds."""
        self._world.launch(self, self._launch)

    @property
    def rgb_EHW3(self) -> UInt8[Tensor, "E H W 3"]:
        """Colors."""
        # Four bytes per pixel, the lowest first: blue, green, red, alpha.
        bytes_EHW4 = wp.to_torch(self._context.rgb_data).view(torch.uint8).view(*self._shape, 4)
        return bytes_EHW4[..., :3].flip(-1)

    @property
    def depth_EHW(self) -> Float32[Tensor, "E H W"]:
        """Distance along the camera's axis (not along the ray), m, 0 where nothing is hit."""
        return wp.to_torch(self._context.depth_data).view(self._shape)

    @property
    def segmentation_EHW2(self) -> Int32[Tensor, "E H W 2"]:
        """MuJoCo's object id and object type of what is hit, -1 for nothing."""
        return wp.to_torch(self._context.seg_data).view(*self._shape, 2)

    def _launch(self) -> None:
        m, d = self._world.warp_model, self._world.warp_data_E
        mjw.refit_bvh(m, d, self._context)
        mjw.render(m, d, self._context)
