"""From logs to recordings and datasets; loads neither training nor the simulator."""

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

from rcirl_jax.data import importing
from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.formats.recognise import recognised_format
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.inputs import input_files
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import Dataset, open_dataset
from rcirl_jax.runtime.checked import typed_fields
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.provenance import provenance
from rcirl_jax.types import Recording

Place = str | os.PathLike[str]


def read_logs(
    path: Place, *, format: str | None = None, source: Place | None = None
) -> Iterator[Recording]:
    """Read the recordings of a log, one at a time, before anything is made of them.

    Args:
      path: file or folder.
      format: one of docs/formats, for example "csv"; None: recognised by names of
        files and columns.
      source: TOML that says what columns mean and which units they have; None: the
        one of the format.

    Returns:
      Recordings: tracks (positions in m, headings in rad, speeds in m/s, times in s),
      lanes and signals.

    Raises:
      InputError: nothing there, a format that nobody knows, or a log that is not as its
        format says.

    Examples:
        >>> for recording in rcirl_jax.read_logs("traffic.toml"):
        ...     print(recording.name, recording.rate_hz, len(recording.lanes))
        highway_straight-01-000 10.0 4
        highway_straight-01-001 10.0 4
    """
    where, toml = Path(path), Path(source) if source else None
    return read_recordings(format or recognised_format(where, toml), where, toml)


def import_logs(
    path: Place,
    output: Place,
    *,
    format: str | None = None,
    source: Place | None = None,
    test_fraction: float = 0.25,
    overwrite: bool = False,
    executor: Executor | None = None,
    **collect: float | bool,
) -> Dataset:
    """Import a log into a dataset of scenes and what people did in them.

    An import that was interrupted goes on where it was when it is called again.

    Args:
      path: as `read_logs`.
      output: folder of the dataset, or a tensorstore URL (`gs://`, `s3://`).
      format: as `read_logs`.
      source: as `read_logs`.
      test_fraction: share of scenes held out; no vehicle is on both sides.
      overwrite: replace a finished dataset.
      executor: where logs are read, of `rcirl_jax.runtime.executors`; None: this
        process. The dataset is the same byte for byte.
      **collect: how scenes are cut out, by the fields of `CollectConfig`; among them
        `stride_s`, s between two scenes of one driver, and `min_future_s`, s of record
        that a scene needs; `require_obstacles=False` and `require_speed_change=False`
        keep the scenes that the paper drops.

    Returns:
      The dataset, open. `dataset.manifest.quality` is the report on the log.

    Raises:
      InputError: bad input, after which nothing stays on disk, or a dataset that is
        there already.

    Examples:
        >>> dataset = rcirl_jax.import_logs(
        ...     "traffic.toml", "other", stride_s=4.0, require_obstacles=False
        ... )
        >>> dataset.count > 50
        True
    """
    settings = typed_fields(CollectConfig, collect, "import_logs: ", ("signal_checks",))
    where, toml = Path(path), Path(source) if source else None
    form = format or recognised_format(where, toml)
    config = ImportConfig(
        format=form, collect=CollectConfig(**settings), test_fraction=test_fraction
    )

    def sign(dataset: Dataset) -> None:
        flags = {"input": str(where), "format": form, **dataclasses.asdict(config)}
        made_by = {"flags": flags, **provenance()}
        dataset.write_facts({"data_hash": dataset.hash, "made_by": made_by})

    importing.import_logs(
        input_files(form, where, toml),
        os.fspath(output),
        config,
        executor=executor,
        overwrite=overwrite,
        before_commit=sign,
    )
    return open_dataset(output, verify=False)
