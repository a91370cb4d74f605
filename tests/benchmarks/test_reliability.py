"""Commands killed, told to end, and without room on the disk: by their command."""

import functools
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from benchmarks.reliability.jobs import jobs, write_logs
from tests.conftest import REPO
from tests.data.small_logs import files_of
from tests.helpers.commands import LONGEST_S
from tests.helpers.commands import fresh as command

pytestmark = [pytest.mark.slow, pytest.mark.multiprocess]


def harness(tmp_path, *flags):
    """(exit status, rows) of the harness."""
    done = command("benchmarks.reliability.faults", f"--output={tmp_path}", *flags)
    (file,) = tmp_path.glob("faults_*.json")
    return done, json.loads(file.read_text())["rows"]


@pytest.mark.parametrize(
    ("signal", "kills"),
    [
        ("KILL", {"import": 3, "train": 3}),
        ("TERM", {"import": 3, "train": 3, "sweep": 2, "autotune": 2}),
    ],
    ids=["KILL", "TERM"],
)
def test_disturbed_commands_come_to_the_same(tmp_path, signal, kills):
    flags = [f"--command={name}" for name in kills] + [f"--kills={sum(kills.values())}"]
    done, rows = harness(tmp_path, *flags, f"--signal={signal}")
    assert done.returncode == 0, done.stdout
    assert [row["count"] for row in rows] == [*kills.values()]
    assert [row["problems"] for row in rows] == [[]] * len(rows)
    assert all(row["comparisons"] >= 1 for row in rows)
    assert all(x < 10.0 for row in rows for x in row["seconds_to_end"])
    assert all(len(row["progress_at_kill"]) == row["count"] for row in rows)
    for row in rows:
        assert any(0 < x < row["things"] for x in row["progress_at_kill"]), row


def test_a_broken_resume_is_found(tmp_path):
    flags = ("--command=train", "--kills=2", "--broken_resume")
    done, (row,) = harness(tmp_path, *flags)
    assert done.returncode == 1
    assert row["problems"][0].startswith("different: ")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """logs/ and data/, a run on it in run/ and its weights."""
    folder = tmp_path_factory.mktemp("reliability") / "root"
    write_logs(folder / "logs")
    for name in ("import", "train"):
        job = jobs(folder)[name]
        assert limited(folder, None, job.module, *job.flags).returncode == 0
    export = ("--run=run", "--output=w.msgpack")
    assert limited(folder, None, "rcirl_jax", "export", *export).returncode == 0
    return folder


@pytest.fixture(scope="module")
def undisturbed(root, tmp_path_factory):
    """Of a job, what comes out when nothing disturbs it."""

    @functools.cache
    def outcome(name):
        job = jobs(root)[name]
        if name in ("import", "train"):
            return job.outcome(root)
        folder = tmp_path_factory.mktemp(name)
        assert limited(folder, None, job.module, *job.flags).returncode == 0
        return job.outcome(folder)

    return outcome


# A program of its own: a fork of this process would be one beside JAX's threads
LIMIT = """import os, resource, sys
size, hard = int(sys.argv[1]), resource.getrlimit(resource.RLIMIT_FSIZE)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
os.execv(sys.executable, [sys.executable, "-m", *sys.argv[2:]])"""


def limited(folder, size, module, *flags):
    """A command that can write no file longer than `size` bytes."""
    start = ["-m"] if size is None else ["-c", LIMIT, str(size)]
    return subprocess.run(
        [sys.executable, *start, module, *flags], cwd=folder, env=environment(),
        text=True, capture_output=True, check=False,
    )  # fmt: skip


def environment():
    """Of a command; JAX's own cache of programs warns when it cannot be written."""
    own = {"PYTHONPATH": str(REPO), "JAX_ENABLE_COMPILATION_CACHE": "0"}
    return {**os.environ, **own, "JAX_PLATFORMS": "cpu"}


def refusal(done):
    """The one line besides progress bars of a command that ended with status 2."""
    assert done.returncode == 2, done.stderr[-2000:]
    said = done.stderr.replace("\r", "\n").splitlines()
    (line,) = [x for x in said if x.strip() and "%|" not in x and "import: " not in x]
    assert line.startswith("error: ")
    return line


def flags_of(root, name):
    """Module and flags of a command, by absolute inputs."""
    known = jobs(root)
    if name in known:  # in one process: a limit also binds what workers share
        flags = [x for x in known[name].flags if not x.startswith("--workers")]
        return known[name].module, flags
    if name == "export":
        data = f"--run={root / 'run'}", f"--data={root / 'data'}"
        return "rcirl_jax", ("export", *data, "--output=w.msgpack")
    data = f"--data={root / 'data'}", "--scenes=4"
    return "rcirl_jax", ("inspect", *data, "--output=look")


@pytest.mark.parametrize(
    ("name", "size", "file"),
    [
        ("import", 3_000, "data"),
        ("train", 0, "run.json"),
        ("train", 6_000, "run"),  # in metrics.jsonl, or before in TensorBoard's
        ("train", 60_000, "checkpoints"),
        ("export", 1_000, "w.msgpack"),
        ("sweep", 3_000, "weights"),
        ("look", 10_000, "look"),
        ("autotune", 3_000, "dataset-"),
    ],
)
def test_a_full_disk_is_one_line_and_the_run_goes_on(
    root, undisturbed, tmp_path, name, size, file
):
    module, flags = flags_of(root, name)
    assert file in refusal(limited(tmp_path, size, module, *flags))
    assert not list(tmp_path.rglob("*.tmp"))
    for final in ("manifest.json", "w.msgpack", "index.html", "sweep.json"):
        assert not list(tmp_path.rglob(final)), final
    assert limited(tmp_path, None, module, *flags).returncode == 0
    if name in jobs(root):
        assert jobs(root)[name].outcome(tmp_path) == undisturbed(name)


@pytest.mark.parametrize("name", ["import", "train", "sweep", "autotune"])
def test_a_second_command_is_refused_and_the_first_not_disturbed(
    root, undisturbed, tmp_path, name
):
    """The first is halted while it has its folder, so that the second meets it."""
    job = jobs(root)[name]
    first = subprocess.Popen(
        [sys.executable, "-m", job.module, *job.flags], cwd=tmp_path, env=environment(),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        while not list(tmp_path.glob("*/.lock")):
            assert first.poll() is None
            time.sleep(0.02)
        first.send_signal(signal.SIGSTOP)
        before = files_of(tmp_path)
        second = limited(tmp_path, None, job.module, *job.flags)
        after = files_of(tmp_path)
        assert first.poll() is None
        first.send_signal(signal.SIGCONT)
        assert first.wait(LONGEST_S) == 0
    finally:
        first.kill()
    assert "in use by another process" in refusal(second)
    assert after == before
    assert job.outcome(tmp_path) == undisturbed(name)


@pytest.mark.parametrize(
    "name", ["import", "train", "export", "sweep", "look", "autotune"]
)
def test_a_place_that_cannot_be_is_one_line(root, tmp_path, name):
    """Below a file, where nobody can make a folder, whoever runs it."""
    (tmp_path / "file").write_text("here")
    module, flags = flags_of(root, name)
    below = [x.replace("--output=", f"--output={tmp_path}/file/") for x in flags]
    line = refusal(limited(tmp_path, None, module, *below))
    assert f"{tmp_path}/file" in line
    assert [x.name for x in tmp_path.iterdir()] == ["file"]
