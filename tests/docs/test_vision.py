"""The page about pictures: its transforms are those of a config."""

import re

import yaml

from ksim_rl.envs import from_tree
from ksim_rl.transforms import TransformCfg
from tests.docs.guide import DOCS


def test_its_chain_of_a_camera_is_built():
    (text,) = re.findall(r"```yaml\n(.*?)```", (DOCS / "vision.md").read_text(), re.DOTALL)
    chain = yaml.safe_load(text)["transforms"]
    built = [
        type(from_tree(TransformCfg, node, name).build()).__name__ for name, node in chain.items()
    ]
    assert built == ["PictureEffects", "ObservationHold", "ObservationDelay", "ObservationHistory"]
