"""No small file hangs a command or fills its memory: sizes are known before anything is allocated."""

import numpy as np
import pytest

from ksim_rl.cli.errors import FAILED, report
from ksim_rl.config import plain_data
from ksim_rl.files import arrays, reading
from ksim_rl.files.arrays import read_arrays
from ksim_rl.runs import csv_table
from ksim_rl.runs.csv_table import read_table
from tests.files import bombs
from tests.files.bombs import BOMBS, read_apart

# Those that take the longest to write or read; other tables and recordings are refused alike.
LONG = ("table_of_30_mb", "table_of_empty_cells", "recording_that_unpacks_to_gigabytes")
NAMES = [pytest.param(name, marks=pytest.mark.full) if name in LONG else name for name in BOMBS]


@pytest.mark.parametrize("name", NAMES)
def test_a_bomb_is_refused_or_read_within_its_limits(name, tmp_path):
    verdict, said = read_apart(BOMBS[name], tmp_path)
    assert verdict in ("refused", "read"), said


def test_what_hangs_and_what_fills_memory_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(bombs, "MOST_SECONDS", 1)

    def spin():
        while True:
            pass

    def fill():
        return bytearray(2**31)

    assert read_apart(lambda folder: fill, tmp_path)[0] == "crash"
    assert read_apart(lambda folder: spin, tmp_path)[0] == "hang"


def test_arrays_are_read_as_numpy_writes_them(tmp_path):
    path = tmp_path / "a.npz"
    written = {
        "numbers": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "names": np.array(["a", "bc"]),
        "one": np.float64(3.5),
        "none": np.zeros((0, 4)),
    }
    for save in (np.savez, np.savez_compressed):
        save(path, **written)
        found = read_arrays(path)
        assert found.keys() == written.keys()
        for name, array in written.items():
            assert found[name].dtype == np.asarray(array).dtype and np.array_equal(
                found[name], array
            )
            assert found[name].flags.writeable


def test_arrays_of_objects_and_too_many_of_them_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"a\.npy: an array of objects, which are pickles"):
        read_arrays(path)
    np.savez(path, a=1, b=2)
    monkeypatch.setattr(arrays, "MOST_ARRAYS", 1)
    with pytest.raises(ValueError, match="it has 2 arrays, more than 1"):
        read_arrays(path)


def test_a_long_table_is_thinned_and_keeps_its_last_row(tmp_path, monkeypatch):
    path = tmp_path / "metrics.csv"
    path.write_text("env_states,a,b\n" + "".join(f"{n},{n},\n" for n in range(101)))
    assert len(read_table(path)[1]) == 101
    monkeypatch.setattr(csv_table, "MOST_CELLS", 50)
    _, rows = read_table(path)
    assert [int(row["env_states"]) for row in rows] == [*range(0, 97, 8), 100]
    assert rows[-1] == {"env_states": "100", "a": "100"}


def test_a_config_is_read_as_hydra_reads_it(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("a: 1e-3\nb: 2026-01-01\nc: [1, true, null, .5, x]\n1: one\n")
    tree = plain_data.read_yaml(path)
    assert tree == {"a": 0.001, "b": "2026-01-01", "c": [1, True, None, 0.5, "x"], 1: "one"}
    path.write_text("a: 1\na: 2\n")
    with pytest.raises(ValueError, match="duplicate key 'a'"):
        plain_data.read_yaml(path)


def test_memory_that_does_not_suffice_is_one_line(capsys):
    assert report(MemoryError("Unable to allocate 7 TiB")) == FAILED
    assert capsys.readouterr().err == "ksim-rl: error: out of memory: Unable to allocate 7 TiB\n"


def test_a_file_with_next_to_nothing_on_the_disk_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "file"
    with open(path, "wb") as file:
        file.write(b"x")
        file.truncate(reading.MOST_SPARSE_BYTES + 1)
    with pytest.raises(ValueError, match=r"of its 67108865 bytes only \d+ were ever written"):
        reading.read_bytes(path, limit=2**30)
