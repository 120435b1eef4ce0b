"""A toy policy that is exported once for a file of tests, and what runs it in a loop."""

import functools
from importlib.util import find_spec

import pytest

# Their modules need onnx and onnxruntime, which an extra brings: files of tests without them are skipped before.


@pytest.fixture(autouse=True, scope="session")
def _one_registry():
    """Let torch's exporter read the signatures of its five hundred functions once, not for each file that it writes."""
    if find_spec("onnxscript") is None:
        yield
        return
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    with pytest.MonkeyPatch.context() as patch:
        once = functools.cache(ONNXRegistry.from_torchlib)
        patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(once))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from tests.export.toy_folder import toy_folder

    return toy_folder(tmp_path_factory.mktemp("toy"))


@pytest.fixture
def control(folder):
    from ksim_rl.export.standalone.files import read_json
    from ksim_rl.export.standalone.policy_control import PolicyControl

    return PolicyControl(folder, read_json(folder / "export.json"))
