"""A toy policy that is exported once for a file of tests, and what runs it in a loop."""

import pytest

# Their modules need onnx and onnxruntime, which an extra brings: files of tests without them are skipped before.


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from tests.export.toy_folder import toy_folder

    return toy_folder(tmp_path_factory.mktemp("toy"))


@pytest.fixture
def control(folder):
    from ksim_rl.export.standalone.files import read_json
    from ksim_rl.export.standalone.policy_control import PolicyControl

    return PolicyControl(folder, read_json(folder / "export.json"))
