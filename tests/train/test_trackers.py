"""What trackers keep of a run, read back with their own readers."""

from pathlib import Path

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.train.metrics import MetricsWriter
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.trackers import settings_of, time_weights, trackers
from rcirl_jax.units import TIMES_S

SETTINGS = settings_of(TrainConfig())


def track(name: str, run: Path) -> None:
    """Two steps, the settings and a picture."""
    [writer] = made = trackers([name], run)
    metrics = MetricsWriter(run, 0, made)
    writer.settings(SETTINGS)
    metrics.write(1, {"loss": 0.5, "pairs": 4.0})
    metrics.write(2, {"loss": 0.25, "pairs": 8.0})
    figure = time_weights(np.linspace(1.0, 0.5, len(TIMES_S)))
    assert figure is not None
    writer.figure(2, "time weights", figure)
    metrics.close()


def events(folder: Path) -> list:
    from tensorboardX.proto.event_pb2 import Event

    from rcirl_jax.data.readers.tfrecord import read_records

    files = sorted(path for path in folder.rglob("events*") if path.is_file())
    return [Event.FromString(bytes(r)) for path in files for r in read_records(path)]


def test_tensorboard(tmp_path):
    track("tensorboard", tmp_path)
    found = events(tmp_path / "tensorboard")
    values = [(e.step, v.tag, v.simple_value) for e in found for v in e.summary.value]
    assert [x for _, tag, x in values if tag == "loss"] == [0.5, 0.25]
    assert (2, "pairs", 8.0) in values
    assert any(v.HasField("image") for e in found for v in e.summary.value)
    [held] = [
        v.metadata.plugin_data.content
        for e in found for v in e.summary.value if "session_start" in v.tag
    ]  # fmt: skip
    assert b"batch_size" in held
    [again] = trackers(["tensorboard"], tmp_path, 1)
    again.close()
    starts = [e.step for e in events(tmp_path / "tensorboard") if e.session_log.status]
    assert starts == [1]  # what is after it is forgotten


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_mlflow(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    track("mlflow", tmp_path / "run")
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'run' / 'mlflow.db'}")
    [experiment] = [e for e in client.search_experiments() if e.name == "rcirl-jax"]
    [found] = client.search_runs([experiment.experiment_id])
    history = client.get_metric_history(found.info.run_id, "loss")
    assert [(m.step, m.value) for m in history] == [(1, 0.5), (2, 0.25)]
    assert found.data.params["batch_size"] == str(TrainConfig().batch_size)
    assert list((tmp_path / "run" / "mlflow").rglob("time_weights_2.png"))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]  # nothing beside it


def test_an_unknown_or_missing_tracker_is_one_line(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"trackers: comet: expected some of"):
        trackers(["comet"], tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "wandb", None)
    with pytest.raises(InputError, match=r"pip install 'rcirl-jax\[wandb\]'"):
        trackers(["wandb"], tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "tensorboardX", None)
    assert trackers(None, tmp_path) == []
