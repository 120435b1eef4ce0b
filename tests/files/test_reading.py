"""Files that a stranger may have written are read as plain data."""

import tracemalloc

import pytest

from ksim_rl.files.reading import read_bytes


def test_memory_is_taken_for_the_file_and_not_for_the_limit(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"x" * 1000)
    tracemalloc.start()
    try:
        content = read_bytes(path, limit=2**30)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert content == b"x" * 1000
    assert peak < 100_000


def test_a_file_beyond_the_limit_and_what_is_no_file_are_refused_by_name(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"x" * 1000)
    with pytest.raises(ValueError, match="file: damaged: longer than the 999 bytes"):
        read_bytes(path, limit=999)
    with pytest.raises(ValueError, match="cannot be read"):
        read_bytes(tmp_path, limit=999)
    with pytest.raises(ValueError, match="none: missing"):
        read_bytes(tmp_path / "none", limit=999)
