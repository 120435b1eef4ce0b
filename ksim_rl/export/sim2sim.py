"""The command `ksim-rl sim2sim`, and its report."""

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ksim_rl.checks import MISFITS, OneLineParser
from ksim_rl.config.child_processes import run_python
from ksim_rl.export.causes import Cause, find_causes, pictures_off
from ksim_rl.export.folder import runner_source
from ksim_rl.export.standalone.description import Export
from ksim_rl.export.standalone.files import check_closed, lacking, read_arrays, read_json
from ksim_rl.physics import load_spec
from ksim_rl.scene.rendering.rendering import choose_gl_platform
from ksim_rl.terminal import printable, show
from ksim_rl.trainers.other_physics import half_time_step, other_integrator, same_time_step

# The figures that are compared, by the beginnings of their names.
TABLE = ("return", "length", "fell", "reward/", "metric/", "torque/", "contact/")


@dataclass(frozen=True, kw_only=True)
class Report:
    """Means over episodes, recorded (`ours`) and on MuJoCo's C engine (`theirs`), and why they differ.

    `standard_error` belongs to `return_ratio`, by the pairs of episodes that began alike.
    """

    task: str
    episodes: int
    ours: Mapping[str, float]
    theirs: Mapping[str, float]
    standard_error: float
    causes: Sequence[Cause]
    left_out: Sequence[str]
    pictures: Mapping[str, float]  # share of pixels that MuJoCo draws otherwise, by camera
    physics: str = ""  # how it differs from the recorded one, where C made that, too

    @property
    def return_ratio(self) -> float:
        """Their mean return by ours, both of the reward terms that the export has."""
        if self.ours["return"]:
            return self.theirs["return"] / self.ours["return"]
        return float("nan")

    def table(self) -> str:
        """Return the report as text."""
        lines = [
            f"{self.task}: {self.episodes} episodes on MuJoCo's C engine, beside the recorded ones"
        ]
        if self.physics:
            lines.append(
                f"which trained it: {self.physics}; single steps are compared in the same physics"
            )
        lines.append(f"{'':<44}{'recorded':>12}{'C engine':>12}{'difference':>12}")
        # A return without some terms is another one than training prints.
        without = lacking(self.left_out)
        for name, value in self.theirs.items():
            if name in self.ours:
                own = self.ours[name]
                # Near zero a relative difference says nothing.
                if abs(own) > 1e-6:
                    share = f"{value / own - 1.0:+.1%}"
                else:
                    share = f"{value - own:+.3g}"
                line = f"{name:<44}{own:>12.4g}{value:>12.4g}{share:>12}"
                lines.append(line + without if name == "return" else line)
        lines += [f"left out, since it cannot be traced: {name}" for name in self.left_out]
        lines.append(
            f"return ratio {self.return_ratio:.4f} +- {self.standard_error:.4f} (standard error)"
        )
        for camera, share in self.pictures.items():
            lines.append(
                f"camera {camera}: {share:.1%} of pixels are drawn otherwise in equal states"
            )
        if self.causes:
            lines.append("likely causes:")
            lines += [f"  {cause}" for cause in self.causes]
        else:
            # Three standard errors, and 0.1 % for what float32 rounds differently.
            beyond = abs(self.return_ratio - 1.0) > 3.0 * self.standard_error + 1e-3
            if beyond:
                what = "but the returns differ by more than chance"
            else:
                what = "what differs above is chance"
            lines.append(
                f"single steps agree: {what}; export with --no-noise compares without the sensors' noise"
            )
        return "\n".join(map(printable, lines))  # names of the export stay in their lines


def sim2sim(
    folder: Path, *, episodes: int = 100, seed: int = 0, note: Callable[[str], None] = show
) -> Report:
    """Run episodes of an exported folder on MuJoCo's C engine, on all cores, and compare them with the recorded ones.

    They run in a Python of their own, by this library's `runner.py`: nothing in the folder is executed. Raises
    ValueError for a folder that is no export, was made without episodes, or does not run.
    """
    if episodes < 1:
        raise ValueError(f"--episodes {episodes}: expected at least 1")
    meta = read_json(folder / "export.json")
    # Everything of the folder is checked here, before a second process opens it.
    ours = _recorded(meta, folder)
    check_closed(folder / "robot.xml")
    physics, words = _other_physics(meta, load_spec(folder / "robot.xml").option)
    note(f"running {episodes} episodes")
    # Our own runner, not the folder's, which may be a stranger's.
    with tempfile.TemporaryDirectory() as temporary:
        program, output, replay = (
            Path(temporary) / name for name in ("runner.py", "out.json", "replay.npz")
        )
        program.write_text(runner_source())
        arguments = [str(folder.absolute()), "--episodes", str(episodes), "--seed", str(seed)]
        arguments += ["--output", str(output), "--replay", str(replay), *physics]
        # Isolated: PYTHONPATH adds no modules either, as the runner needs none of this library.
        done = run_python(["-I", str(program), *arguments], environment=_drawing(meta))
        if done.returncode:
            # The runner says in one line why it refused; that line becomes ours.
            last = (done.stderr.strip() or "no message").splitlines()[-1]
            said = last.removeprefix("runner.py: error: ")
            raise ValueError(said if str(folder.absolute()) in said else f"{folder}: {said}")
        found = json.loads(output.read_text())
        # Arrays of wrong shapes fail anywhere in the comparison: it is the files that are wrong.
        try:
            replayed = read_arrays(replay)
            pictures = pictures_off(meta, replayed)
            causes = find_causes(meta, read_arrays(folder / "trace.npz"), replayed)
        except (*MISFITS, ValueError) as error:
            raise ValueError(f"{folder}: trace.npz does not fit export.json: {error!r}") from error
    # The same episodes on both sides, in pairs, and returns of the same terms.
    pairs = np.arange(episodes) % len(ours["return"])
    own = {name: values[pairs] for name, values in ours.items() if name.startswith(TABLE)}
    theirs = {}
    for name in found[0]:
        if name.startswith(TABLE):
            theirs[name] = np.array([one[name] for one in found])
    # Only terms that both sides have: the recorded return also has those that cannot be traced.
    described = [own[name] for name in own if name.startswith("reward/") and name in theirs]
    own["return"] = np.sum(described, axis=0) if described else np.zeros(episodes)
    return Report(
        task=str(meta.get("task")),
        episodes=episodes,
        ours={name: float(values.mean()) for name, values in own.items()},
        theirs={name: float(values.mean()) for name, values in theirs.items()},
        standard_error=ratio_error(own["return"], theirs["return"]),
        causes=causes,
        pictures=pictures,
        left_out=[str(name) for name in meta.get("left_out", ())],
        physics=words,
    )


def _drawing(meta: Export) -> dict[str, str] | None:
    """Return the environment of a process that draws pictures; a ValueError says how to install a renderer."""
    if not meta.get("pictures"):
        return None
    try:
        return {"MUJOCO_GL": choose_gl_platform()}
    except RuntimeError as error:
        raise ValueError(f"the policy sees, and nothing draws for it here: {error}") from None


def _other_physics(meta: Export, option: mujoco.MjOption) -> tuple[list[str], str]:
    """Return the runner's arguments for judging an export with the C engine, and the words for them."""
    # Warp is other physics already.
    if meta.get("engine") != "c":
        return [], ""
    # The engine that trained it would agree with itself: judge by another integrator.
    integrator, words = other_integrator(option)
    laws = meta.get("actuators")
    # Lags of actuators count substeps: half the step would be half the lag.
    late = isinstance(laws, list) and any(
        isinstance(law, dict) and law.get("delay") for law in laws
    )
    if late:
        return ["--integrator", integrator], f"{words}, {same_time_step(option.timestep)}"
    arguments = ["--integrator", integrator, "--refine", "2"]
    return arguments, f"{words}, {half_time_step(option.timestep)}"


def _recorded(meta: Export, folder: Path) -> dict[str, np.ndarray]:
    """Return the figures of the recorded episodes [N] by name; a ValueError names a figure that no export writes."""
    ours = meta.get("ours")
    if not isinstance(ours, dict) or not ours.get("return"):
        raise ValueError(
            f"{folder}: exported without episodes: export the run once more, with --episodes 100"
        )
    # The returns give the count that all other figures must have.
    returns = ours["return"]
    if isinstance(returns, list):
        count = len(returns)
    else:
        count = 0
    found = {}
    for name, values in ours.items():
        numbers = isinstance(values, list) and all(
            isinstance(value, int | float) for value in values
        )
        if not numbers or len(values) != count:
            raise ValueError(
                f"{folder}: export.json: ours.{name}: expected a number for each recorded episode"
            )
        found[name] = np.array(values, np.float64)
    return found


def ratio_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the standard error of mean(theirs) / mean(ours) of pairs [N]; NaN for fewer than two, or a mean of 0."""
    mean = float(ours.mean())
    if len(ours) < 2 or mean == 0.0:
        return float("nan")
    # Delta method: the spread of theirs around the ratio's line through the pairs.
    left = theirs - ours * theirs.mean() / mean
    spread_of_mean = np.std(left, ddof=1) / np.sqrt(len(ours))
    return float(spread_of_mean / abs(mean))


def run_sim2sim(arguments: Sequence[str]) -> int:
    """Run `ksim-rl sim2sim DIR`; the code is 1 where single steps differ."""
    parser = OneLineParser(
        prog="ksim-rl sim2sim",
        description="Run an exported policy on MuJoCo's C engine, and compare.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="what `ksim-rl export` wrote")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of noise and lags")
    options: Any = parser.parse_args(arguments)
    report = sim2sim(options.folder, episodes=options.episodes, seed=options.seed)
    show(report.table())
    # Differing returns alone are no failure: chance moves them.
    return 1 if report.causes else 0
