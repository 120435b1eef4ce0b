"""These events draw the looks of a scene: lenses of cameras, lights, and colours of materials and geoms."""

from dataclasses import dataclass
from typing import Literal

from ksim_rl.mdp.randomization.randomize import Operation, RandomizeModelField
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeCameraFieldOfView(RandomizeModelField):
    """Vertical field of view of the model's cameras, degrees; with a sensor size, see `RandomizeCameraIntrinsic`."""

    field = "cam_fovy"
    lowest = 1.0
    highest = 179.0

    cameras: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeCameraIntrinsic(RandomizeModelField):
    """Lenses of the model's cameras, m; columns: focal lengths x and y, principal point x and y."""

    field = "cam_intrinsic"
    columns = 4

    operation: Operation = "scale"
    cameras: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeLightColor(RandomizeModelField):
    """Colour of lights; columns red, green, blue of one `part` of the light."""

    columns = 3
    lowest = 0.0

    lights: Patterns
    part: Literal["ambient", "diffuse", "specular"] = "diffuse"

    @property
    def field(self) -> str:
        """The field of that part."""
        # MuJoCo keeps each part of a light in a field of its own.
        return f"light_{self.part}"


@dataclass(frozen=True, kw_only=True)
class RandomizeMaterialColor(RandomizeModelField):
    """Colour of materials, on all geoms that have them; columns red, green, blue, alpha, within [0, 1]."""

    field = "mat_rgba"
    columns = 4
    lowest = 0.0
    highest = 1.0
    columns_of_one_pair = (0, 1, 2)
    materials: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeMaterialShine(RandomizeModelField):
    """How materials give back light, within [0, 1]: emission, and how strongly or how sharply they reflect lights."""

    lowest = 0.0
    highest = 1.0

    materials: Patterns
    part: Literal["emission", "specular", "shininess"] = "specular"

    @property
    def field(self) -> str:
        """The field of that part."""
        # MuJoCo keeps each part of a material in a field of its own.
        return f"mat_{self.part}"


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomColor(RandomizeModelField):
    """Colour of geoms, in place of their material's; columns red, green, blue, alpha, within [0, 1]."""

    field = "geom_rgba"
    columns = 4
    lowest = 0.0
    highest = 1.0
    columns_of_one_pair = (0, 1, 2)
    geoms: Patterns
