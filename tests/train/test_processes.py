"""Training by several processes on loopback, also killed and started again."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.train.loop import restore_run
from rcirl_jax.train.parallel import EXIT_LOST, join_processes
from tests.conftest import REPO
from tests.helpers.commands import QUICKLY
from tests.helpers.stored import assert_same_bits, leaves
from tests.train.worker import CONFIG

pytestmark = pytest.mark.multiprocess
# compiled eight times as fast; what is compared is compiled alike
QUICK = f"{QUICKLY} --xla_llvm_disable_expensive_passes=true"
STEPS = 6  # 21 rows, batches of 8, two epochs: the last batch of an epoch has 5


def free_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def start(data, workdir, parallel, processes, devices, **changes):
    """The processes of one training; devices are those of each."""
    workdir.mkdir(parents=True, exist_ok=True)
    several = processes > 1
    job = {
        "data": str(data),
        "workdir": str(workdir),
        "parallel": parallel,
        "address": f"127.0.0.1:{free_port()}" if several else None,
        "num_processes": processes if several else None,
        "kill_after": -1,
        "victims": list(range(processes)),
        "in_memory_mb": 0.0,
        "pause_s": 0.0,
        **changes,
    }
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": QUICK}
    env["JAX_NUM_CPU_DEVICES"] = str(devices)
    workers = []
    for number in range(processes):
        own = json.dumps({**job, "process_id": number if several else None})
        with (workdir / f"stderr_{number}").open("w") as stderr:
            command = [sys.executable, "-m", "tests.train.worker", own]
            workers.append(
                subprocess.Popen(
                    command, cwd=REPO, env=env, stdout=subprocess.DEVNULL, stderr=stderr
                )
            )
    return workers


def finished(workers, workdir):
    """Wait; what each process saw."""
    for number, worker in enumerate(workers):
        code = worker.wait(600)
        assert code == 0, (workdir / f"stderr_{number}").read_text()[-3000:]
    names = sorted(workdir.glob("process_*.json"))
    assert len(names) == len(workers)
    return [json.loads(name.read_text()) for name in names]


@pytest.fixture(scope="module")
def two_by_two(four_shards, tmp_path_factory):
    """(folder, what each saw) of two processes of two devices."""
    folder = tmp_path_factory.mktemp("two_by_two")
    workers = start(four_shards, folder, "shard_map", 2, 2)
    return folder, finished(workers, folder)


def assert_equals(folder, state):
    """Sums over devices are added in another order: equal to rounding, no further."""
    for a, b in zip(leaves(restore_run(folder, CONFIG)), leaves(state), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5)


def assert_same_runs(one, other):
    assert_same_bits(*(restore_run(folder, CONFIG) for folder in (one, other)))


def test_two_processes_of_two_devices_equal_one(two_by_two, undisturbed):
    folder, seen = two_by_two
    assert_equals(folder, undisturbed.state)
    wanted = {n: [x[n] for x in undisturbed.epochs] for n in ("pairs", "loss")}
    for process in seen:
        assert process["devices"] == 4
        assert process["steps"] == STEPS
        assert process["pairs"] == wanted["pairs"]
        np.testing.assert_allclose(process["loss"], wanted["loss"], rtol=1e-3)


def test_one_process_writes_what_is_written_once(two_by_two):
    folder, _ = two_by_two
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == list(range(1, STEPS + 1))
    assert len(list((folder / "tensorboard").iterdir())) == 1
    assert (folder / "run.json").is_file()
    assert "%" not in (folder / "stderr_1").read_text()  # no second progress bar


def lines_of(workdir, number):
    """What a process said besides its progress bar."""
    said = (workdir / f"stderr_{number}").read_text().replace("\r", "\n").splitlines()
    return [line for line in said if line.strip() and "%|" not in line]


@pytest.mark.slow
@pytest.mark.parametrize("victim", [1, 0])
def test_who_loses_another_process_ends_with_one_line(
    four_shards, two_by_two, tmp_path, victim
):
    """One is killed; the other does not wait for it; both start again.

    Without number 0, which coordinates, jax may end the other itself, between two
    steps: with SIGABRT and lines of its own.
    """
    workers = start(
        *(four_shards, tmp_path, "shard_map", 2, 2),
        kill_after=2, victims=[victim], pause_s=0.2,
    )  # fmt: skip
    other = 1 - victim
    assert workers[victim].wait(600) == -signal.SIGKILL
    begin = time.monotonic()
    status = workers[other].wait(120)
    assert time.monotonic() - begin < 30.0
    assert status == EXIT_LOST or (victim == 0 and status == -signal.SIGABRT)
    if status == EXIT_LOST:
        said = [x for x in lines_of(tmp_path, other) if x.startswith("error: ")]
        assert len(said) == 1
        assert "another process is lost" in said[0]
        assert "Traceback" not in (tmp_path / f"stderr_{other}").read_text()
    finished(start(four_shards, tmp_path, "shard_map", 2, 2), tmp_path)
    assert_same_runs(tmp_path, two_by_two[0])


@pytest.mark.slow
def test_one_process_told_to_end_stops_all_at_the_same_step(
    four_shards, two_by_two, tmp_path
):
    workers = start(four_shards, tmp_path, "shard_map", 2, 2, pause_s=1.5)
    while not (tmp_path / "step_1").exists():
        assert workers[1].poll() is None, lines_of(tmp_path, 1)[-20:]
        time.sleep(0.05)
    workers[1].send_signal(signal.SIGTERM)
    assert [worker.wait(60) for worker in workers] == [143, 143]
    steps = [(tmp_path / f"step_{number}").read_text() for number in (0, 1)]
    assert steps[0] == steps[1]
    assert 1 <= int(steps[0]) < STEPS
    assert (tmp_path / "checkpoints" / steps[0]).is_dir()
    finished(start(four_shards, tmp_path, "shard_map", 2, 2), tmp_path)
    assert_same_runs(tmp_path, two_by_two[0])


@pytest.mark.slow
def test_killed_processes_resume_to_the_bit(four_shards, two_by_two, tmp_path):
    """Both die inside the second epoch, and pass over a damaged checkpoint."""
    workers = start(four_shards, tmp_path, "shard_map", 2, 2, kill_after=4)
    assert workers[0].wait(600) == -signal.SIGKILL
    workers[1].kill()  # it may have lost its peer just before its own signal
    assert workers[1].wait(60) != 0
    assert not list(tmp_path.glob("process_*.json"))
    noted = tmp_path / "checkpoints" / "4" / "position" / "metadata"
    noted.write_bytes(noted.read_bytes()[:-1])
    again = start(four_shards, tmp_path, "shard_map", 2, 2, in_memory_mb=100.0)
    # the one before is of step 3, at the end of the first epoch
    left = [STEPS - 3] * 2
    assert [process["steps"] for process in finished(again, tmp_path)] == left
    assert_same_runs(tmp_path, two_by_two[0])
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == list(range(1, STEPS + 1))
    said = [lines_of(tmp_path, number) for number in (0, 1)]
    assert sum("checkpoint 4: position/metadata" in x for x in said[0]) == 1
    assert not any("checkpoint 4" in x for x in said[1])


@pytest.mark.slow
def test_another_way_of_sharing(four_shards, undisturbed, tmp_path):
    finished(start(four_shards, tmp_path, "pmap", 2, 2), tmp_path)
    assert_equals(tmp_path, undisturbed.state)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("host:1", 2, None), "expected all three or none"),
        (("host", 2, 1), "coordinator_address: host: expected host:port"),
        (("host:1", 2, 2), "process_id: 2: expected 0 to 1"),
    ],
)
def test_bad_flags_are_one_line(given, message):
    with pytest.raises(InputError, match=message):
        join_processes(*given)
