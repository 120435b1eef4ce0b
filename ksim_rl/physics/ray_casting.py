"""Casts rays in all worlds: for a sensor, or for the picture of a camera."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from ksim_rl.device.streams import warp_scope
from ksim_rl.physics.c_engine.c_world import CWorld
from ksim_rl.physics.upstream import add_height_fields
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.physics.world import World

Groups = wp.types.vector(length=mujoco.mjNGROUP, dtype=wp.float32)


class RayBatch:
    """N rays per world: write `start_EN3` (m) and `direction_EN3` (unit vectors), both in the world frame, then `cast`.

    `refresh` must have run since the state changed. Rays hit geoms of MuJoCo's `geom_groups`, but none of the
    body with the id `exclude_body`.

    Attributes:
        distance_EN: m to the first geom that is hit, -1 for none, float32.
        normal_EN3: unit normal of the surface there, world frame, float32.
    """

    def __init__(
        self, world: World, num_rays: int, *, geom_groups: Sequence[int], exclude_body: int = -1
    ) -> None:
        self._world = world
        # All -1 would mean every group, so groups are switched one by one.
        self._chosen = [group in geom_groups for group in range(mujoco.mjNGROUP)]
        # MuJoCo Warp takes floats, and C takes booleans.
        self._groups = Groups(*map(float, self._chosen))
        self._exclude_body = exclude_body
        shape = (world.num_envs, num_rays)
        # Arrays are allocated once: graphs keep their addresses.
        with warp_scope(world.device):
            self._start, self._direction, self._normal = (
                wp.zeros(shape, dtype=wp.vec3) for _ in range(3)
            )
            self._distance = wp.zeros(shape, dtype=float)
            self._geom = wp.zeros(shape, dtype=int)
            self._exclude = wp.array(np.full(num_rays, exclude_body, dtype=np.int32), dtype=int)
        self.start_EN3 = wp.to_torch(self._start)
        self.direction_EN3 = wp.to_torch(self._direction)
        self.distance_EN = wp.to_torch(self._distance)
        self.normal_EN3 = wp.to_torch(self._normal)

    def cast(self) -> None:
        """Cast all rays against the present poses of the geoms."""
        world = self._world
        # Warp's rays are launches in order with the world's; C casts them on the host.
        if isinstance(world, WarpWorld):
            world.launch(self, partial(self._launch, world))
            return
        assert isinstance(world, CWorld)
        distance_EN, normal_EN3 = world.cast_rays(
            self.start_EN3, self.direction_EN3, self._chosen, self._exclude_body
        )
        self.distance_EN.copy_(distance_EN)
        self.normal_EN3.copy_(normal_EN3)

    def _launch(self, world: WarpWorld) -> None:
        found = self._distance, self._geom, self._normal
        m = world.warp_model
        d = world.warp_data_E
        # True: geoms that are fixed to the world are hit, too.
        mjw.rays(m, d, self._start, self._direction, self._groups, True, self._exclude, *found)


@dataclass(frozen=True, kw_only=True)
class Picture:
    """The pictures of a camera: width and height in pixels, their kinds, and which geoms are seen."""

    width: int
    height: int
    rgb: bool = True
    depth: bool = False
    segmentation: bool = False
    geom_groups: Sequence[int] = (0, 1, 2)
    textures: bool = True
    shadows: bool = False


class BatchCamera:
    """Pictures of a camera in each world, as MuJoCo Warp's ray-casting renderer drew them last.

    `refresh` must have run since the state changed. The model's sky counts as a texture.
    """

    def __init__(
        self,
        world: World,
        camera: str,
        picture: Picture,
    ) -> None:
        if not isinstance(world, WarpWorld):
            raise ValueError(
                f"camera {camera!r} draws pictures of all worlds by MuJoCo Warp: choose sim.engine='warp'"
            )
        self._world = world
        self._camera = camera
        model = world.mj_model
        fields = world.per_world_fields()
        world.view("cam_xpos")  # so that refreshes place cameras and lights
        with warp_scope(world.device):
            self._context = mjw.create_render_context(
                model,
                nworld=world.num_envs,
                cam_res=(picture.width, picture.height),
                render_rgb=picture.rgb,
                render_depth=picture.depth,
                render_seg=picture.segmentation,
                use_textures=picture.textures,
                use_shadows=picture.shadows,
                render_skybox=picture.textures,
                enabled_geom_groups=list(picture.geom_groups),
                cam_active=[camera],
                # Rays may be computed once only if no world has a lens of its own.
                use_precomputed_rays=not {"cam_fovy", "cam_intrinsic"} & fields.keys(),
            )
            # The renderer has height fields of the model's own geoms only.
            if "geom_dataid" in fields:
                add_height_fields(self._context, model)
        self._shape = (world.num_envs, picture.height, picture.width)
        drawn = {
            "rgb": picture.rgb,
            "depth": picture.depth,
            "seg": picture.segmentation,
        }
        # Views of the renderer's memory, which stays; to make one in each step would wait for the device.
        self._views = {
            name: wp.to_torch(getattr(self._context, f"{name}_data"))
            for name, is_drawn in drawn.items()
            if is_drawn
        }

    def render(self) -> None:
        """Draw the present state of all worlds."""
        self._world.launch(self, self._launch)

    @property
    def rgb_EHW3(self) -> UInt8[Tensor, "E H W 3"]:
        """Colors."""
        # Four bytes per pixel, the lowest first: blue, green, red, alpha.
        bytes_EHW4 = self._views["rgb"].view(torch.uint8).view(*self._shape, 4)
        return bytes_EHW4[..., :3].flip(-1)

    @property
    def depth_EHW(self) -> Float32[Tensor, "E H W"]:
        """Distance along the camera's axis (not along the ray), m, 0 where nothing is hit."""
        return self._views["depth"].view(self._shape)

    @property
    def segmentation_EHW2(self) -> Int32[Tensor, "E H W 2"]:
        """MuJoCo's id and type of the object that is hit, -1 for nothing."""
        return self._views["seg"].view(*self._shape, 2)

    def _launch(self) -> None:
        # Bounding volumes follow the poses before rays are cast through them.
        m = self._world.warp_model
        d = self._world.warp_data_E
        mjw.refit_bvh(m, d, self._context)
        mjw.render(m, d, self._context)
