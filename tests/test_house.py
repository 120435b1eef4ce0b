"""The package keeps the limits of `python -m tests.house`, and each limit is one that can be broken."""

import subprocess
from pathlib import Path

import pytest

from tests import density, house, signatures

ROOT = Path(__file__).parents[1]

_TENSORS = """\"\"\"This module has tensors.\"\"\"
from jaxtyping import Float
from torch import Tensor

Index = slice | Tensor

class Thing:
    @property
    def good_E(self) -> Float[Tensor, " E"]: ...
    def __call__(self, x_EL: Float[Tensor, "E L"], *, y_ET_t_plus_1: Float[Tensor, "E T 1"] | None = None) -> int: ...
    def _inner(self, x: Tensor) -> Tensor: ...
"""

# What to write into a sound tree so that a limit breaks, and what the finding says.
BREAKS = {
    "room_shares": ({"ksim_rl/scene/more.py": "x = 1\n" * 100}, "scene has 39"),
    "file_lengths": ({"ksim_rl/scene/long.py": "x = 1\n" * 451}, "scene/long.py has 451"),
    "folder_sizes": ({f"ksim_rl/scene/part_{n}.py": "" for n in range(31)}, "scene has 3"),
    "vague_names": ({"ksim_rl/scene/utils.py": ""}, "scene/utils.py"),
    "circles": (
        {
            "ksim_rl/scene/a.py": "if TYPE_CHECKING:\n    from ksim_rl.mdp import b\n",
            "ksim_rl/mdp/b.py": "def f():\n    import ksim_rl.scene.a\n",
        },
        "ksim_rl.mdp.b <-> ksim_rl.scene.a",
    ),
    "contract_size": ({"ksim_rl/envs/contract.py": "x = 1\n" * 121}, "121 lines"),
    "bare_tensors": (
        {"ksim_rl/scene/a.py": _TENSORS + "    def read(self, at: Index) -> None: ...\n"},
        "at: Index",
    ),
    "suffixes": (
        {"ksim_rl/scene/a.py": _TENSORS + "    bad_L: Float[Tensor, 'E L']\n"},
        "bad_L has the axes 'E L'",
    ),
    "probes": (
        {"ksim_rl/trainers/a.py": "def f(env):\n    return hasattr(env, 'x')\n"},
        "hasattr(env, 'x')",
    ),
    "tests_in_place": ({"tests/old_room/test_a.py": "x = 1\n"}, "tests/old_room is of no room"),
    "crammed": (
        {"ksim_rl/scene/a.py": "x = [a if a else 0 for a in (1, 2)]\n"},
        "scene/a.py:1",
    ),
    "long_signatures": (
        {
            "ksim_rl/scene/a.py": "def shown(a, b, c, d, e, f, g, h, *, i): ...\n",
            "ksim_rl/scene/b.py": "def _own(" + ", ".join(f"a{n}" for n in range(13)) + "): ...\n",
        },
        "shown has 9: 8 at most",
    ),
    "means": (
        {
            "ksim_rl/scene/a.py": "x = ((1, 2, 3), (4, 5, 6), (7, 8, 9), (1, 2, 3), (4, 5, 6))\n"
            * 200
        },
        "tokens in a line",
    ),
}


@pytest.fixture
def sound(tmp_path):
    """Write a checkout that keeps every limit."""
    for room in ("scene", "mdp", "trainers", "envs", "physics"):
        _write(tmp_path, {f"ksim_rl/{room}/thing.py": '"""This module has a thing."""\nx = 1\n'})
        _write(tmp_path, {f"tests/{room}/test_thing.py": "x = 1\n"})
    _write(
        tmp_path,
        {
            "ksim_rl/envs/contract.py": '"""This module is the contract."""\n',
            "ksim_rl/scene/t.py": _TENSORS,
        },
    )
    _write(
        tmp_path,
        {
            f"ksim_rl/{room}/size.py": "x = 1\n" * 40
            for room in ("mdp", "trainers", "envs", "physics")
        },
    )
    for path in tmp_path.rglob("size.py"):
        path.write_text('"""This module has a size."""\n' + path.read_text())
    return tmp_path


def _write(checkout, files):
    for name, text in files.items():
        path = checkout / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


# `make check`, which comes first in `make test`, asks the same.
@pytest.mark.full
@pytest.mark.parametrize("limit", house.LIMITS, ids=lambda limit: house.LIMITS[limit].__name__)
def test_the_package_keeps_its_limits(limit):
    broken = house.LIMITS[limit](house.House(ROOT))
    assert not broken, "\n".join([limit, *broken])


def test_a_sound_tree_keeps_every_limit(sound, capsys):
    assert house.main(["--root", str(sound)]) == 0, capsys.readouterr().out
    assert "FAILS" not in capsys.readouterr().out


@pytest.mark.parametrize("name", BREAKS)
def test_each_limit_can_be_broken(sound, name, capsys):
    files, finding = BREAKS[name]
    _write(sound, files)
    broken = getattr(house, name)(house.House(sound))
    assert any(finding in line for line in broken), broken
    assert house.main(["--root", str(sound)]) == 1
    assert "FAILS" in capsys.readouterr().out


def test_every_limit_is_broken_once():
    assert {check.__name__ for check in house.LIMITS.values()} == set(BREAKS)


def test_subjects_of_commits_fit_into_a_line():
    assert not density.long_subjects(ROOT)


def test_a_long_subject_is_found(tmp_path):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.example"]
    subprocess.run([*git, "init", "--quiet"], check=True)
    for letters in (72, 73):
        subprocess.run(
            [*git, "commit", "--quiet", "--allow-empty", "-m", "x" * letters], check=True
        )
    assert density.long_subjects(tmp_path, "HEAD") == ["x" * 73]


def test_a_root_without_the_package_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no folder ksim_rl"):
        house.House(tmp_path)


@pytest.mark.parametrize(
    "name, axes, agrees",
    [
        ("qpos_EL", "E L", True),
        ("qpos_L", "E L", False),
        ("qpos", "E L", False),
        ("mask_E", " E", True),
        ("obs_ETL_t_plus_1", "E T L", True),
        ("reward_ET", "E T 1", True),
        ("reward_ET1", "E T 1", True),
        ("mean_E3", "E 3", True),
        ("pos_EL", "E 3", True),
        ("mean_E", "E 3", False),
        ("axes_3", "3", True),
        ("std", "", True),
        ("std_L", "", False),
        ("any_EL", "*batch L", True),
    ],
)
def test_suffixes(name, axes, agrees):
    assert signatures.suffix_agrees(name, axes) == agrees


@pytest.mark.parametrize(
    "line, finding",
    [
        ("def f(model: mujoco.MjModel): ...", "model is a mj_model"),
        ("data = mjw.put_data(m, d)", "data is a warp_data_E"),
        ("def f(m: mjw.Model | None): ...", "m is a warp_model"),
        ("def f(self, other_mj_model: mujoco.MjModel): ...", None),
        ("self._warp_model = mjw.put_model(mj_model)", None),
    ],
)
def test_models_have_their_names(tmp_path, line, finding):
    (tmp_path / "a.py").write_text(line)
    assert [name.split(" ", 1)[1] for name in signatures.wrong_names(tmp_path)] == [finding] * (
        finding is not None
    )


@pytest.mark.parametrize(
    "annotation, bare",
    [
        ("Tensor", True),
        ("torch.Tensor | None", True),
        ("Mapping[str, Tensor]", True),
        ("'Tensor'", True),
        ('Float[Tensor, "..."]', True),
        ('Float[Any, "E L"]', True),
        ('Float[Tensor, "_ L"]', True),
        ('Float[Tensor, "E L"]', False),
        ('dict[str, Float[Tensor, " E"]]', False),
        ("TensorDict", False),
    ],
)
def test_bare_annotations(annotation, bare):
    assert signatures.is_bare(signatures.parse(annotation).body[0].value, set()) == bare
