"""The page about pictures: its transforms are those of a config."""

import re

import yaml

from ksim_rl.envs import from_tree
from ksim_rl.transforms import TransformCfg
from tests.docs.guide import DOCS


def test_its_chain_of_a_camera_is_built():
    (text,) = re.findall(r"```yaml\n(.*?)```", (DOCS / "vision.md").read_text(), re.DOTALL)
    chain = yaml.safe_load(text)["transforms"]
    transforms = [from_tree(TransformCfg, node, name).build() for name, node in chain.items()]
    assert transforms[1].out_keys == ["wrist", ("camera", "fresh")]
    built = [type(transform).__name__ for transform in transforms]
    assert built == ["PictureEffects", "ObservationHold", "ObservationDelay", "ObservationHistory"]
