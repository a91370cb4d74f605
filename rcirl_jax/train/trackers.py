"""Trackers show training runs beside each other; metrics.jsonl is written anyway.

A tracker is anything with the four methods of `Writer`; a further one is a class here
and its name in `TRACKERS`. Its package is imported when it is asked for.
"""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import named
from rcirl_jax.runtime.checked import leaves
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.units import TIMES_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Setting = str | float | bool  # an integer is a float to type checkers


class Writer(Protocol):
    """A further place for a run's numbers, besides metrics.jsonl."""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Numbers of a step, by name; NaN where there was none."""
        ...

    def settings(self, values: Mapping[str, Setting]) -> None:
        """Takes the run's settings by name; once, before the first step."""
        ...

    def figure(self, step: int, name: str, figure: "Figure") -> None:
        """A picture of a step."""
        ...

    def close(self) -> None:
        """Everything is written; no call follows."""
        ...


class _TensorBoard:
    """An event file in `tensorboard/`, by tensorboardX (extra `report`).

    On resume, TensorBoard forgets what was written after the resumed step. By its
    RecordWriter, not its SummaryWriter, whose thread a full disk or a clock that is set
    ends in silence.
    """

    FLUSH_S = 10.0  # s between two flushes

    def __init__(self, run: Path, resume_step: int) -> None:
        import tensorboardX
        from tensorboardX import summary
        from tensorboardX.proto import event_pb2

        self._events: Any = event_pb2  # its classes are made as it is loaded
        self._summary = summary
        self._folder = run / "tensorboard"
        self._folder.mkdir(parents=True, exist_ok=True)
        # two runs in one second must not share a file
        own = f"{int(time.time())}.{os.getpid()}.{len(list(self._folder.iterdir()))}"
        path = self._folder / f"events.out.tfevents.{own}"
        self._file = self._do(lambda: tensorboardX.RecordWriter(str(path)))
        self._flushed = time.monotonic()
        self._add(file_version="brain.Event:2")
        if resume_step:
            start = self._events.SessionLog(status=self._events.SessionLog.START)
            self._add(step=resume_step, session_log=start)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        for name, number in values.items():
            self._add(step=step, summary=self._summary.scalar(name, number))
        if time.monotonic() - self._flushed > self.FLUSH_S:
            self._flushed = time.monotonic()
            self._do(self._file.flush)

    def settings(self, values: Mapping[str, Setting]) -> None:
        for part in self._summary.hparams(dict(values), {}):
            self._add(summary=part)

    def figure(self, step: int, name: str, figure: "Figure") -> None:
        from tensorboardX.utils import figure_to_image

        picture = figure_to_image(figure, close=False)
        self._add(step=step, summary=self._summary.image(name, picture))

    def close(self) -> None:
        with contextlib.suppress(OSError):  # metrics.jsonl has the numbers
            self._file.close()

    def _add(self, **event: Any) -> None:  # noqa: ANN401
        made = self._events.Event(wall_time=time.time(), **event)
        self._do(lambda: self._file.write(made.SerializeToString()))

    def _do(self, work: Callable[[], Any]) -> Any:  # noqa: ANN401
        try:
            return work()
        except OSError as error:
            raise named(error, self._folder) from error


class _MLflow:
    """A run of MLflow (extra `mlflow`), where MLFLOW_TRACKING_URI says.

    Without that variable in `mlflow.db` and `mlflow/` of the run's folder, so that
    nothing leaves the machine unasked.
    """

    def __init__(self, run: Path, resume_step: int) -> None:
        import mlflow

        run.mkdir(parents=True, exist_ok=True)
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", "rcirl-jax")
        if "MLFLOW_TRACKING_URI" not in os.environ:
            mlflow.set_tracking_uri(f"sqlite:///{(run / 'mlflow.db').absolute()}")
            if mlflow.get_experiment_by_name(name) is None:
                mlflow.create_experiment(name, (run / "mlflow").absolute().as_uri())
        self._mlflow = mlflow
        mlflow.set_experiment(name)
        mlflow.start_run(run_name=run.name, tags={"resumed_at": str(resume_step)})

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        self._mlflow.log_metrics(dict(values), step=step)

    def settings(self, values: Mapping[str, Setting]) -> None:
        self._mlflow.log_params(dict(values))

    def figure(self, step: int, name: str, figure: "Figure") -> None:
        self._mlflow.log_figure(figure, f"{name.replace(' ', '_')}_{step}.png")

    def close(self) -> None:
        self._mlflow.end_run()


class _WandB:
    """A run of Weights & Biases (extra `wandb`) in `wandb/` of the run's folder.

    Offline unless WANDB_MODE says otherwise; `wandb sync` uploads it later.
    """

    def __init__(self, run: Path, resume_step: int) -> None:
        import wandb

        run.mkdir(parents=True, exist_ok=True)
        self._wandb, self._run = (
            wandb,
            wandb.init(
                project=os.environ.get("WANDB_PROJECT", "rcirl-jax"),
                name=run.name,
                dir=str(run),
                mode=None if "WANDB_MODE" in os.environ else "offline",
                config={"resumed_at": resume_step},
            ),
        )

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=step)

    def settings(self, values: Mapping[str, Setting]) -> None:
        self._run.config.update(dict(values))

    def figure(self, step: int, name: str, figure: "Figure") -> None:
        self._run.log({name: self._wandb.Image(figure)}, step=step)

    def close(self) -> None:
        self._run.finish()


# name -> (class, extra that installs it)
TRACKERS: dict[str, tuple[Callable[[Path, int], Writer], str]] = {
    "tensorboard": (_TensorBoard, "report"),
    "mlflow": (_MLflow, "mlflow"),
    "wandb": (_WandB, "wandb"),
}


def trackers(
    names: Sequence[str] | None, run: Path, resume_step: int = 0
) -> list[Writer]:
    """Writers of a run's folder, by name.

    Args:
      names: of `TRACKERS`; None: TensorBoard if it is installed.
      run: folder of the run.
      resume_step: last step that counts of those written before.

    Raises:
      InputError: a name is unknown or its package is not installed.
    """
    made = []
    for name in ("tensorboard",) if names is None else names:
        if name not in TRACKERS:
            raise InputError(f"trackers: {name}: expected some of {list(TRACKERS)}")
        tracker, extra = TRACKERS[name]
        try:
            made.append(tracker(run, resume_step))
        except ImportError as error:
            if names is not None:
                raise InputError(
                    f"trackers: {name}: not installed: expected the extra {extra}: "
                    f"pip install 'rcirl-jax[{extra}]'"
                ) from error
    return made


def settings_of(config: TrainConfig) -> dict[str, Setting]:
    """All settings of a training as one level: `batch_size`, `reward.hidden`."""
    found = leaves(dataclasses.asdict(config))
    plain = (str, int, float)
    return {n: x if isinstance(x, plain) else str(x) for n, x in found.items()}


def time_weights(gamma: np.ndarray) -> "Figure | None":
    """Gamma [T] over time [s], or None without matplotlib (extra `report`)."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return None
    figure = Figure(figsize=(5.0, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(TIMES_S[: len(gamma)], gamma, marker="o")
    axes.axhline(0.0, color="grey", linewidth=0.5)
    axes.set(xlabel="time, s", ylabel="time weight gamma")
    return figure
