"""A folder of small CSV logs for tests of where and how often an import runs."""

from pathlib import Path

import numpy as np

from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.inputs import InputFile, input_files
from rcirl_jax.data.scenes.config import CollectConfig

CONFIG = ImportConfig(
    format="csv",
    collect=CollectConfig(stride_s=1.0, min_future_s=5.2),
    test_fraction=0.3,
)


def write_logs(folder: Path, files: int = 6, seconds: float = 16.0) -> list[InputFile]:
    """Platoons of four on a straight road, one file each; their parts."""
    folder.mkdir(parents=True, exist_ok=True)
    t = np.arange(0.0, seconds, 0.1)
    for number in range(files):
        rng = np.random.default_rng(number)
        lines = ["t,id,x,y"]
        for car in range(4):
            wave = 2.0 * np.sin(0.4 * t + rng.uniform(0.0, 6.0))
            speed = 12.0 + wave
            x = 30.0 * (3 - car) + np.cumsum(speed) * 0.1
            lines += [
                f"{a:.1f},{number}-{car},{b:.3f},0" for a, b in zip(t, x, strict=True)
            ]
        (folder / f"log{number:02d}.csv").write_text("\n".join(lines) + "\n")
    return input_files("csv", folder)


def files_of(folder: Path) -> dict[Path, bytes]:
    """Every file's bytes by its name inside the folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder): path.read_bytes() for path in files}
