"""Takes a trained policy out of the library: into a folder that runs with numpy, onnxruntime and MuJoCo."""

from ksim_rl.export.exported_transforms import stage
from ksim_rl.export.folder import export, export_policy
from ksim_rl.export.refusal import NotDescribedError
from ksim_rl.export.sim2sim import Report, sim2sim
