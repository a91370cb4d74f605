"""Imports in other processes, on a Ray cluster, and killed: the same bytes."""

import pytest

from rcirl_jax.data import importing
from rcirl_jax.data import inputs as dealing
from rcirl_jax.data.formats import parts
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.inputs import InputFile, work_units
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.executors import Processes, Ray
from tests.data.formats.fixtures import apollo, l5, nuplan, waymo
from tests.data.small_logs import CONFIG, files_of, write_logs
from tests.helpers.commands import python

ALL_SCENES = ImportConfig(
    format="waymo",
    collect=CollectConfig(require_speed_change=False, require_obstacles=False),
)


@pytest.fixture(scope="module", autouse=True)
def few_scenes_in_a_shard():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importing, "SHARD_SCENES", 30)
        yield


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


@pytest.fixture
def second_is_long(shards, monkeypatch):
    """The second of the shards is longer than the limit."""
    monkeypatch.setattr(dealing, "is_long", lambda part: part.input == shards[1].input)


@pytest.mark.usefixtures("second_is_long")
def test_long_files_and_few_are_read_in_this_process(shards):
    """A file that is dealt out is one unit; else each of its recordings is one."""

    def dealt(files):
        return [isinstance(unit, InputFile) for unit in work_units(files, 2)]

    assert dealt(shards) == [True, False, False, *[True] * (len(shards) - 2)]
    assert dealt(shards[:1]) == [False, False]


@pytest.mark.multiprocess
@pytest.mark.usefixtures("second_is_long")
def test_shards_read_by_workers_and_here_give_the_bytes_of_one_process(
    shards, tmp_path
):
    import_logs(shards, tmp_path / "two", ALL_SCENES, executor=Processes(2))
    import_logs(shards, tmp_path / "one", ALL_SCENES)
    assert files_of(tmp_path / "two") == files_of(tmp_path / "one")


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
def test_a_ray_cluster_that_loses_a_node_writes_the_bytes_of_one_process(tmp_path):
    """A head and two nodes, each its own processes; one node is killed midway."""
    pytest.importorskip("ray")
    import_logs(write_logs(tmp_path / "here"), tmp_path / "local", CONFIG)
    assert len(list((tmp_path / "local").rglob("shard.json"))) > 2
    done = python(RAY, tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert files_of(tmp_path / "data") == files_of(tmp_path / "local")


@pytest.mark.ray
def test_no_cluster_is_one_line():
    pytest.importorskip("ray")
    with pytest.raises(InputError, match=r"ray_address: 127\.0\.0\.1:1: "):
        Ray("127.0.0.1:1")
