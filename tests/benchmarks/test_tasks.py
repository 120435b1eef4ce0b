import json

import pytest
import torch

from benchmarks import tasks
from ksim_rl import envs
from ksim_rl.collectors import RolloutCollector

ON_CPU = ("device=cpu", "num_envs=4")


def run(folder, *words: str) -> tuple[int, dict]:
    code = tasks.main([*ON_CPU, f"results={folder}", *words])
    return code, json.loads((folder / "tasks.json").read_text())


def test_a_task_is_checked_and_timed(tmp_path):
    code, saved = run(tmp_path, "tasks=cartpole_balance")
    assert code == 0
    outcome = {"check_env": "passed", "check_device": "cpu", "findings": [], "error": ""}
    assert saved["outcomes"] == {"cpu/cartpole_balance/4": outcome}
    figures = {key.rpartition("/")[2]: value for key, value in saved["figures"].items()}
    # Position, sine and cosine of the angle, two velocities; one force.
    assert (figures["actor_size"], figures["critic_size"], figures["action_size"]) == (5, 5, 1)
    assert figures["syncs"] == 0
    physics_per_s = 1000.0 * 4 / figures["physics_ms"]
    expected = pytest.approx(figures["env_states_per_s"] / physics_per_s, rel=1e-3, abs=1e-5)
    assert figures["rollout_over_physics"] == expected


def test_what_fails_is_in_its_row_and_the_rest_goes_on(tmp_path, monkeypatch, capsys):
    def check(env):
        raise AssertionError("TheEnv has 1 findings:\n[values] not finite")

    def broken_check(env):
        raise RuntimeError("no kernel\nin a traceback")

    def time(name, options, figures, outcome):
        if name == "arm_push":
            raise RuntimeError("no such cube\nin a traceback")
        figures["syncs"] = 0

    monkeypatch.setattr(tasks, "check_env", check)
    monkeypatch.setattr(tasks, "_time", time)
    code, saved = run(tmp_path, "tasks=arm_push", "check_device=none")
    assert code == 1
    assert saved["outcomes"]["cpu/arm_push/4"]["error"] == "RuntimeError: no such cube"
    code, saved = run(tmp_path, "tasks=arm_push,cartpole_swingup", "check_device=none")
    assert code == 1
    assert saved["outcomes"]["cpu/cartpole_swingup/4"]["error"] == ""
    code, saved = run(tmp_path / "checked", "tasks=cartpole_balance")
    assert code == 1
    assert saved["outcomes"]["cpu/cartpole_balance/4"]["findings"] == ["[values] not finite"]
    monkeypatch.setattr(tasks, "check_env", broken_check)
    code, saved = run(tmp_path / "broken", "tasks=cartpole_balance")
    assert code == 1
    found = saved["outcomes"]["cpu/cartpole_balance/4"]
    assert (found["check_env"], found["findings"]) == (
        "failed",
        ["[check_env] RuntimeError: no kernel"],
    )
    assert saved["figures"]["cpu/cartpole_balance/4/syncs"] == 0
    assert "cpu/arm_push/4: RuntimeError: no such cube" in capsys.readouterr().out


def test_a_policy_that_reads_the_device_is_seen():
    env = envs.make("cartpole_balance", num_envs=4, seed=0)

    def policy(td):
        force = float(td["actor"].sum())
        return td.set("action", torch.full((4, 1), 0.0 * force))

    collector = RolloutCollector(env, policy, rollout_length=2)
    collector.collect()
    (sync,) = tasks.host_syncs(collector, torch.device("cpu"))
    assert "test_tasks.py" in sync
    env.close()


def test_shards_share_the_tasks_out():
    names = envs.names()
    for count in (1, 3, 4, len(names)):
        parts = [tasks.shard(names, f"{index}/{count}") for index in range(count)]
        assert [name for part in parts for name in part] == names
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
    with pytest.raises(ValueError, match="shard=4"):
        tasks.shard(names, "4/4")
    with pytest.raises(ValueError, match="2 tasks"):
        tasks.shard(["one", "two"], "0/3")


def test_unknown_words_are_refused():
    with pytest.raises(ValueError, match="'num_envs'"):
        tasks.options(["num_env=4"])
    with pytest.raises(ValueError, match="'cartpole_balance'"):
        tasks.options(["tasks=cartpole_balanc"])


def test_merging_prints_all_and_fails_if_any_task_failed(tmp_path, monkeypatch, capsys):
    def time(name, options, figures, outcome):
        figures["syncs"] = 0
        if name == "arm_push" and failing:
            outcome.findings.append("[syncs] a wait")

    monkeypatch.setattr(tasks, "_time", time)
    failing = False
    run(tmp_path / "0", "tasks=arm_push", "check_device=none")
    run(tmp_path / "1", "tasks=arm_reach", "check_device=none")
    capsys.readouterr()
    words = [f"results={tmp_path}", str(tmp_path / "0"), str(tmp_path / "1")]
    assert tasks.main(["merge", *words]) == 0
    assert set(json.loads((tmp_path / "tasks.json").read_text())["outcomes"]) == {
        "cpu/arm_push/4",
        "cpu/arm_reach/4",
    }
    shown = capsys.readouterr().out
    assert "cpu/arm_push/4" in shown and "cpu/arm_reach/4" in shown
    failing = True
    run(tmp_path / "0", "tasks=arm_push", "check_device=none")
    assert tasks.main(["merge", *words]) == 1
