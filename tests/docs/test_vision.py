"""The page about pictures: its transforms are a config's."""

import re

import yaml

from ksim_rl.envs import from_tree
from ksim_rl.transforms import TransformCfg
from tests.docs.guide import DOCS


def test_its_chain_of_a_camera_is_built():
    (text,) = re.findall(r"```yaml\n(.*?)```", (DOCS / "vision.md").read_text(), re.DOTALL)
    chain = yaml.safe_load(text)["transforms"]
    transforms = [from_tree(TransformCfg, node, name).build() for name, node in chain.items()]
    # Where a picture is late, the flag that tells whether it is new is as late.
    assert transforms[1].out_keys == transforms[2].in_keys == ["wrist", ("camera", "fresh")]
    built = [type(transform).__name__ for transform in transforms]
    assert built == ["PictureEffects", "ObservationHold", "ObservationDelay", "ObservationHistory"]
