"""Imports in other processes, on a Ray cluster, and killed: the same bytes."""

import subprocess
import sys

import pytest

from rcirl_jax.data import importing
from rcirl_jax.data import inputs as dealing
from rcirl_jax.data.formats import parts
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.inputs import InputFile, recordings_of
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError, LostWorkError
from rcirl_jax.runtime.executors import Processes, Ray, Serial
from tests.data.formats.fixtures import apollo, l5, nuplan, waymo
from tests.data.small_logs import CONFIG, files_of, write_logs

ALL_SCENES = ImportConfig(
    format="waymo",
    collect=CollectConfig(require_speed_change=False, require_obstacles=False),
)
TWO = Processes(2)


@pytest.fixture(scope="module", autouse=True)
def few_scenes_in_a_shard():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importing, "SHARD_SCENES", 30)
        yield


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return write_logs(tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="module")
def local(logs, tmp_path_factory):
    """What an import in this process writes, in shards of few scenes."""
    folder = tmp_path_factory.mktemp("local") / "data"
    import_logs(logs, folder, CONFIG)
    assert len(list(folder.rglob("shard.json"))) > 2
    return files_of(folder)


@pytest.mark.multiprocess
def test_two_processes_write_the_bytes_of_one(logs, local, tmp_path):
    import_logs(logs, tmp_path / "data", CONFIG, executor=TWO)
    assert files_of(tmp_path / "data") == local


def reads_of_this_process(monkeypatch):
    """Names of the inputs that the importing process reads itself, as it does."""
    read = []

    def noted(part):
        read.append(part.input.name)
        return recordings_of(part)

    monkeypatch.setattr(dealing, "recordings_of", noted)
    return read


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Four Waymo shards of two scenarios each; a nuPlan log, an Apollo drive, L5."""
    folder = tmp_path_factory.mktemp("shards")
    waymo.write_shards(folder / "waymo")
    made = []
    places = [("waymo", folder / "waymo")]
    for other in (nuplan, apollo, l5):
        name = other.__name__.rpartition(".")[2]
        (folder / name).mkdir()
        places.append((name, other.write(folder / name).input))
    for name, place in places:
        found, spec = parts(name, place)
        spec = {**spec, "recording_car": "human"}  # the only one seen for long
        made += [InputFile(format=name, input=path, spec=spec) for path in found]
    return made


@pytest.fixture(scope="module")
def here(shards, tmp_path_factory):
    """What an import of the shards in this process writes."""
    folder = tmp_path_factory.mktemp("here") / "data"
    import_logs(shards, folder, ALL_SCENES)
    return files_of(folder)


@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("count", "long", "read_here"), [(None, (), []), (None, [1], [1]), (1, (), [0])]
)
def test_shards_are_read_by_the_workers_but_long_ones_and_few(
    shards, here, tmp_path, monkeypatch, count, long, read_here
):
    """One that is longer than the limit, or fewer than workers: in this process."""
    inputs = [part.input for part in shards]
    if long:
        known = [inputs[number] for number in long]
        monkeypatch.setattr(dealing, "is_long", lambda part: part.input in known)
    read = reads_of_this_process(monkeypatch)
    import_logs(shards[:count], tmp_path / "data", ALL_SCENES, executor=TWO)
    assert read == [inputs[number].name for number in read_here]
    assert count or files_of(tmp_path / "data") == here


@pytest.mark.multiprocess
def test_bad_input_elsewhere_is_the_same_line_and_leaves_nothing(logs, tmp_path):
    broken = tmp_path / "logs"
    parts = write_logs(broken)
    (broken / "log03.csv").write_text("t,id,x,y\n0.0,a,far,0\n")
    with pytest.raises(InputError, match=r"log03\.csv: line 2: x: 'far': expected a"):
        import_logs(parts, tmp_path / "data", CONFIG, executor=TWO)
    assert not (tmp_path / "data").exists()


RAY = """
import os, sys, time
from pathlib import Path
import ray
from ray.cluster_utils import Cluster
from rcirl_jax.data import importing
from rcirl_jax.runtime.executors import Ray
from tests.data.small_logs import CONFIG, write_logs

importing.SHARD_SCENES = 30
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
cluster.wait_for_nodes()
executor = Ray(cluster.address)
assert executor.workers == 2, executor.workers

class Killing:
    workers = 2
    def stream(self, function, items):
        for number, result in enumerate(executor.stream(function, items)):
            if number == 1:
                cluster.remove_node(nodes[0], allow_graceful=False)
            yield result

os.chdir(sys.argv[1])  # the nodes were started elsewhere
parts = write_logs(Path("logs"))
importing.import_logs(parts, "data", CONFIG, executor=Killing())
deadline = time.monotonic() + 90.0  # the loss of a node is noticed late
while sum(node["Alive"] for node in ray.nodes()) != 2:  # the head and the other
    assert time.monotonic() < deadline, "no node was lost"
    time.sleep(0.5)
ray.shutdown()
cluster.shutdown()
"""


@pytest.mark.ray
@pytest.mark.slow
def test_a_ray_cluster_that_loses_a_node_writes_the_bytes_of_one_process(
    local, tmp_path
):
    """A head and two nodes, each its own processes; one node is killed midway."""
    pytest.importorskip("ray")
    done = subprocess.run(
        [sys.executable, "-c", RAY, str(tmp_path)],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert files_of(tmp_path / "data") == local


class Losing:
    """Loses its workers for good before a result; until then as in this process."""

    workers = 1

    def __init__(self, before):
        self.before = before

    def stream(self, function, items):
        for number, result in enumerate(Serial().stream(function, items)):
            if number == self.before:
                raise LostWorkError("log: its process was killed: expected memory")
            yield result


def test_lost_workers_leave_what_is_finished(logs, local, tmp_path):
    data = tmp_path / "data"
    with pytest.raises(LostWorkError):
        import_logs(logs, data, CONFIG, executor=Losing(4))
    kept = {path: path.stat().st_mtime_ns for path in data.rglob("shard.json")}
    assert kept
    assert not (data / "manifest.json").exists()
    import_logs(logs, data, CONFIG)
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    assert files_of(data) == local


@pytest.mark.ray
def test_no_cluster_is_one_line():
    pytest.importorskip("ray")
    with pytest.raises(InputError, match=r"ray_address: 127\.0\.0\.1:1: "):
        Ray("127.0.0.1:1")
