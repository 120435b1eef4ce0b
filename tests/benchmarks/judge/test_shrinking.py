"""A model that fails is made small, whatever fails."""

import xml.etree.ElementTree as ET

from benchmarks.judge.shrinking import shrunk

XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="a" pos="0 0 1"><joint name="j"/><geom name="g" size="0.1" margin="0.1" friction="1"/>
      <body name="b"><joint name="k"/><geom name="h" size="0.1"/></body>
    </body>
  </worldbody>
  <sensor><jointpos joint="j"/></sensor>
</mujoco>
"""


def has_margin(xml: str, fields: tuple[str, ...]) -> bool:
    return (
        any(element.get("margin") for element in ET.fromstring(xml).iter("geom"))
        and "geom_gap" in fields
    )


def test_only_what_fails_is_left():
    xml, fields = shrunk(XML, ("geom_gap", "body_mass"), has_margin)
    root = ET.fromstring(xml)
    assert [element.tag for element in root.iter()] == [
        "mujoco",
        "option",
        "worldbody",
        "body",
        "geom",
    ]
    assert [geom.attrib for geom in root.iter("geom")] == [{"name": "g", "margin": "0.1"}]
    assert fields == ("geom_gap",)


def test_no_more_trials_than_allowed():
    trials = []

    def fails(xml: str, fields: tuple[str, ...]) -> bool:
        trials.append(xml)
        return False

    assert shrunk(XML, (), fails, most_trials=3) == (XML, ())
    assert len(trials) == 3
