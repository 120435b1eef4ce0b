from benchmarks.learning_time import LEVELS, reached


def curve(*pairs):
    names = list(LEVELS)
    return [
        {"env_states": 1e6 * i, "seconds": 10.0 * i, names[0]: linear, names[1]: angular}
        for i, (linear, angular) in enumerate(pairs)
    ]


GOOD, BAD = (1.5, 1.3), (1.5, 0.9)


def test_the_end_is_where_both_levels_hold_for_a_million_env_states():
    found = reached(curve(BAD, BAD, GOOD, GOOD, GOOD))
    assert found is not None and (found["env_states"], found["seconds"]) == (3e6, 30.0)


def test_a_single_good_point_is_not_enough():
    assert reached(curve(BAD, GOOD, (1.0, 1.0), BAD)) is None
    assert reached(curve(BAD, BAD, GOOD)) is None
