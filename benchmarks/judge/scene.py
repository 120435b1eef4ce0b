"""The model that is being written: its XML, and the names that later elements refer to."""

import dataclasses
import xml.etree.ElementTree as ET


def _section(name: str) -> ET.Element:
    return ET.Element(name)


@dataclasses.dataclass(kw_only=True)
class Scene:
    """The sections of a model, and the names of what is in them.

    Attributes:
        joints: names by type: "hinge", "slide", "ball", "free".
        geoms: names by type; `moving_geoms` the names on bodies that move.
        bodies: names of bodies that move; `tools` those without joints of their own, `mocaps` those that mocap moves.
        sites, moving_sites: names of all sites, and of those on bodies that move.
        pad: the site of a touch sensor.
    """

    worldbody: ET.Element = dataclasses.field(default_factory=lambda: _section("worldbody"))
    asset: ET.Element = dataclasses.field(default_factory=lambda: _section("asset"))
    tendon: ET.Element = dataclasses.field(default_factory=lambda: _section("tendon"))
    equality: ET.Element = dataclasses.field(default_factory=lambda: _section("equality"))
    contact: ET.Element = dataclasses.field(default_factory=lambda: _section("contact"))
    actuator: ET.Element = dataclasses.field(default_factory=lambda: _section("actuator"))
    sensor: ET.Element = dataclasses.field(default_factory=lambda: _section("sensor"))
    joints: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    geoms: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    moving_geoms: list[str] = dataclasses.field(default_factory=list)
    bodies: list[str] = dataclasses.field(default_factory=list)
    tools: list[str] = dataclasses.field(default_factory=list)
    mocaps: list[str] = dataclasses.field(default_factory=list)
    sites: list[str] = dataclasses.field(default_factory=list)
    moving_sites: list[str] = dataclasses.field(default_factory=list)
    touch_sites: list[str] = dataclasses.field(default_factory=list)
    cameras: list[str] = dataclasses.field(default_factory=list)
    fixed_tendons: list[str] = dataclasses.field(default_factory=list)
    spatial_tendons: list[str] = dataclasses.field(default_factory=list)
    limited_joints: list[str] = dataclasses.field(default_factory=list)
    limited_tendons: list[str] = dataclasses.field(default_factory=list)
    actuators: list[str] = dataclasses.field(default_factory=list)

    def scalars(self) -> list[str]:
        """Return the names of joints with one degree of freedom."""
        return self.joints.get("hinge", []) + self.joints.get("slide", [])

    def all_geoms(self) -> list[str]:
        """Return the names of all geoms."""
        return [name for names in self.geoms.values() for name in names]

    def text(self, option: ET.Element, extra: list[ET.Element]) -> str:
        """Return the XML of the whole model."""
        root = ET.Element("mujoco")
        compiler = ET.SubElement(root, "compiler", angle="radian", autolimits="true")
        compiler.set("inertiafromgeom", "auto")
        root.append(option)
        sections = (
            self.asset,
            self.worldbody,
            self.contact,
            self.tendon,
            self.equality,
            self.actuator,
            self.sensor,
        )
        for section in (*sections, *extra):
            if len(section):
                root.append(section)
        ET.indent(root)
        return ET.tostring(root, encoding="unicode")
