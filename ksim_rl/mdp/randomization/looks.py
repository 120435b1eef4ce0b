"""These events draw what cameras see: their lenses, lights, and colours of materials and geoms."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from ksim_rl.mdp.randomization.randomize import Operation, RandomizeModelField
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeCameraFieldOfView(RandomizeModelField):
    """Vertical field of view of the model's cameras, degrees; with a sensor size, see `RandomizeCameraIntrinsic`."""

    cameras: Patterns
    field: ClassVar[str] = "cam_fovy"
    lowest: ClassVar[float | None] = 1.0
    highest: ClassVar[float | None] = 179.0


@dataclass(frozen=True, kw_only=True)
class RandomizeCameraIntrinsic(RandomizeModelField):
    """Lenses of the model's cameras, m; columns: focal lengths x and y, principal point x and y."""

    cameras: Patterns
    field: ClassVar[str] = "cam_intrinsic"
    columns: ClassVar[int] = 4
    operation: Operation = "scale"


@dataclass(frozen=True, kw_only=True)
class RandomizeLightColor(RandomizeModelField):
    """Colour of lights; columns red, green, blue of one `part` of the light."""

    lights: Patterns
    part: Literal["ambient", "diffuse", "specular"] = "diffuse"
    columns: ClassVar[int] = 3
    lowest: ClassVar[float | None] = 0.0

    @property
    def field(self) -> str:
        """The field of that part."""
        return f"light_{self.part}"


@dataclass(frozen=True, kw_only=True)
class RandomizeMaterialColor(RandomizeModelField):
    """Colour of materials, on all geoms that have them; columns red, green, blue, alpha, within [0, 1]."""

    materials: Patterns
    field: ClassVar[str] = "mat_rgba"
    columns: ClassVar[int] = 4
    lowest: ClassVar[float | None] = 0.0
    highest: ClassVar[float | None] = 1.0


@dataclass(frozen=True, kw_only=True)
class RandomizeMaterialShine(RandomizeModelField):
    """How materials give back light, within [0, 1]: what they emit, how strongly or how sharply they reflect lights."""

    materials: Patterns
    part: Literal["emission", "specular", "shininess"] = "specular"
    lowest: ClassVar[float | None] = 0.0
    highest: ClassVar[float | None] = 1.0

    @property
    def field(self) -> str:
        """The field of that part."""
        return f"mat_{self.part}"


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomColor(RandomizeModelField):
    """Colour of geoms, in place of their material's; columns red, green, blue, alpha, within [0, 1]."""

    geoms: Patterns
    field: ClassVar[str] = "geom_rgba"
    columns: ClassVar[int] = 4
    lowest: ClassVar[float | None] = 0.0
    highest: ClassVar[float | None] = 1.0
