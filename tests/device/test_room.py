"""What no memory holds is refused by the name of the field that asks for it."""

from ksim_rl.device import room
from tests.cli import wrong_sizes


def test_whole_numbers_that_no_memory_holds_are_refused_before_anything_is_allocated(monkeypatch):
    monkeypatch.setattr(room, "total_bytes", lambda device: wrong_sizes.LITTLE_BYTES)
    taken = set()
    for cfg, _, numbers in wrong_sizes.configs():
        for path, is_list in numbers:
            value = wrong_sizes.HUGE[1]
            said = wrong_sizes.refusal(cfg, path, [value, value] if is_list else value)
            if not said:
                taken.add(path)
            else:
                assert path.rpartition(".")[2] in said
    assert taken == wrong_sizes.FREE
