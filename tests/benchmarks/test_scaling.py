from benchmarks.scaling import draw, growth


def test_growth_is_of_training_from_4096_to_32768():
    figures = {4096: {"env_states_per_s": 400.0}, 32768: {"env_states_per_s": 1000.0}}
    assert growth(figures) == {"growth_4096_to_32768": 2.5}
    assert growth({1024: {"env_states_per_s": 1.0}}) == {}


def test_the_chart_is_drawn(tmp_path):
    row = {"env_states_per_s": 4e5, "physics_env_states_per_s": 5e5}
    path = tmp_path / "chart.png"
    made = draw({4096: row, 8192: row}, path, task_name="go1_velocity_flat", device="a GPU")
    assert "drawn" in made and path.read_bytes().startswith(b"\x89PNG")


def test_one_number_of_envs_leaves_an_earlier_chart_as_it_is(tmp_path):
    path = tmp_path / "chart.png"
    path.write_bytes(b"of an earlier run")
    row = {"env_states_per_s": 4e5, "physics_env_states_per_s": 5e5}
    assert "left as it is" in draw(
        {32768: row}, path, task_name="go1_velocity_flat", device="a GPU"
    )
    assert path.read_bytes() == b"of an earlier run"
