"""The command line under torchrun: whole runs, on two ranks and on two times two, and what kills one."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest

pytestmark = pytest.mark.full

RUN = [
    "task=cartpole_balance",
    "device=cpu",
    "num_envs=8",
    "data.num_env_states_per_minibatch=64",
    "data.num_minibatches=2",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
    "task.episode_length_s=0.2",
    "trainer.num_threads=1",
    "trainer.eval_episodes=3",
    "trainer.video=false",
    "trainer.stop_when_solved=false",
]


def torchrun(*arguments, folder, options=("--nproc-per-node=2",), endpoint="localhost:0"):
    command = [sys.executable, "-m", "torch.distributed.run", "--rdzv-backend=c10d"]
    command += [f"--rdzv-endpoint={endpoint}", *options, "-m", "ksim_rl.cli.main", *arguments]
    return subprocess.Popen(
        command,
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finished(process):
    text, _ = process.communicate(timeout=600)
    assert process.returncode == 0, text
    return text


def test_rank_0_writes_one_run_which_goes_on_in_one_process(tmp_path):
    text = finished(torchrun("train", *RUN, "trainer.num_iterations=2", folder=tmp_path))
    assert "on each of 2 ranks, 16 envs and 256 in all" in text
    assert text.count("iteration 1/2:") == 1
    assert "evaluation over 4 episodes" in text, "three do not share out equally"
    (run,) = (tmp_path / "runs" / "cartpole_balance").iterdir()
    rows = (run / "metrics.csv").read_text().splitlines()
    header = rows[0].split(",")
    assert "throughput/slowest_rank" in header
    text = finished(torchrun("resume", str(run), "--num-iterations=3", folder=tmp_path))
    assert "iteration 3/3: env states 768" in text
    alone = subprocess.run(
        [
            sys.executable,
            "-m",
            "ksim_rl.cli.main",
            "resume",
            str(run),
            "--num-iterations=4",
            "--device=cpu",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert "16 envs x 16 steps = 256 env states" in alone.stdout, alone.stdout + alone.stderr
    assert json.loads((run / "evaluation.json").read_text())["iteration"] == 4


def test_two_nodes_of_two_ranks_are_one_run(tmp_path):
    options = ("--nnodes=2", "--nproc-per-node=2", "--rdzv-id=nodes")
    with_port = {"folder": tmp_path, "options": options, "endpoint": "localhost:29617"}
    nodes = [torchrun("train", *RUN, "trainer.num_iterations=1", **with_port) for _ in range(2)]
    texts = [finished(node) for node in nodes]
    assert sum("on each of 4 ranks, 32 envs and 512 in all" in text for text in texts) == 1


def kill_rank_1(process, at, how=signal.SIGKILL):
    """Kill or stop it when the run says `at`; return what was said until then, and the process of each rank."""
    lines = []
    while not lines or at not in lines[-1]:
        lines.append(process.stdout.readline())
        assert lines[-1], "".join(lines)
    ranks = subprocess.run(
        ["pgrep", "-P", str(process.pid)], capture_output=True, text=True, check=True
    )
    processes = [int(number) for number in ranks.stdout.split()]
    os.kill(processes[1], how)
    return "".join(lines), processes


def is_running(number):
    """Whether a process is there, and not as one that has ended and waits for its parent."""
    status = Path(f"/proc/{number}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_killed_rank_is_started_again_and_the_run_goes_on_from_its_newest_checkpoint(tmp_path):
    options = ("--nproc-per-node=2", "--max-restarts=1")
    run = [*RUN, "trainer.checkpoint_interval=4", "trainer.num_iterations=30"]
    process = torchrun("train", *run, folder=tmp_path, options=options)
    text = kill_rank_1(process, "iteration 6/")[0] + finished(process)
    numbers = [int(found) for found in re.findall(r"iteration (\d+)/30:.*slowest rank", text)]
    again = next(i for i, (a, b) in enumerate(pairwise(numbers), 1) if b < a + 1)
    print(f"killed after iteration {numbers[again - 1]}, went on with {numbers[again]}")
    assert numbers[again] % 4 == 1 and numbers[again] > 1
    assert numbers[again:] == list(range(numbers[again], 31))
    (run,) = (tmp_path / "runs" / "cartpole_balance").iterdir()
    rows = (run / "metrics.csv").read_text().splitlines()
    assert [int(row.split(",")[0]) for row in rows[1:]] == list(range(256, 31 * 256, 256))


def test_a_stopped_rank_ends_the_others_within_35_s(tmp_path):
    options = ("--nproc-per-node=4",)
    process = torchrun(
        "train", *RUN, "trainer.num_iterations=100000", folder=tmp_path, options=options
    )
    _, processes = kill_rank_1(process, "iteration 2/", signal.SIGSTOP)
    began = time.monotonic()
    stopped = processes.pop(1)
    while any(is_running(number) for number in processes) and time.monotonic() < began + 60:
        time.sleep(0.1)
    seconds = time.monotonic() - began
    # Else torchrun waits for it.
    os.kill(stopped, signal.SIGKILL)
    text, _ = process.communicate(timeout=60)
    print(f"three ranks had ended {seconds:.1f} s after the fourth was stopped")
    assert seconds < 35 and process.returncode != 0
    assert "error: rank 1 is silent since 30 s (" in text


def test_a_killed_rank_ends_the_others_with_its_cause(tmp_path):
    process = torchrun("train", *RUN, "trainer.num_iterations=100000", folder=tmp_path)
    kill_rank_1(process, "iteration 2/")
    began = time.monotonic()
    text, _ = process.communicate(timeout=60)
    print(f"all ranks had ended {time.monotonic() - began:.1f} s after one was killed")
    assert process.returncode != 0
    assert "exitcode  : -9" in text
