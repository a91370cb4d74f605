"""Memory and speed of importing a CSV log that does not fit into memory.

    python -m benchmarks.long_log --gigabytes=2

Writes a generated log (platoons on a straight road) of the size asked for, then
imports it by the command a user would type, with `--workers`, and watches the
memory of the importing process and of all its workers.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from absl import flags

from benchmarks.common import LANE_TOML, write
from benchmarks.reliability.memory import below_of, resident_of
from experiments.common import run

_SIZE = flags.DEFINE_float("gigabytes", 2.0, "size of the generated log")
_STRIDE = flags.DEFINE_float("stride", 20.0, "s between planning frames of a driver")
_WORKERS = flags.DEFINE_integer("processes", 2, "workers of the import")
_FOLDER = flags.DEFINE_string("folder", None, "where the log is written (2x its size)")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

CARS = 100  # at any time
STAY_S = 60.0  # s that a car is seen


def write_log(path: Path, size: float) -> int:
    """Rows of cars that enter one after the other until the file is `size` bytes."""
    frame = written = 0
    with path.open("w") as file:
        file.write("t,id,x,y\n")
        while file.tell() < size:
            now = np.arange(frame, frame + 100)
            lines = []
            for f in now.tolist():
                t = 0.1 * f
                newest = int(t * CARS / STAY_S)
                car = np.arange(max(newest - CARS + 1, 0), newest + 1)
                age = t - car * STAY_S / CARS
                # all drive the same waves, so that nobody runs into another
                x = 35.0 * age + 6.0 * np.sin(0.3 * age)
                lines += [
                    f"{t:.1f},vehicle-{c:08d},{a:.4f},0.1000\n"
                    for c, a in zip(car.tolist(), x.tolist(), strict=True)
                ]
            file.writelines(lines)
            written += len(lines)
            frame += 100
    return written


class Watch(threading.Thread):
    """Largest resident memory of a process and of it with all its children, MiB."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self.pid, self.one, self.all = pid, 0.0, 0.0

    def run(self) -> None:
        """Look ten times a second until the process is gone."""
        while Path(f"/proc/{self.pid}").exists():
            own = resident_of(self.pid)
            self.one = max(self.one, own)
            self.all = max(self.all, own + sum(map(resident_of, below_of(self.pid))))
            time.sleep(0.1)


def main() -> None:
    """Write, import, report."""
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as place:
        folder = Path(place)
        log, toml = folder / "log.csv", folder / "log.toml"
        toml.write_text(LANE_TOML)
        rows = write_log(log, _SIZE.value * 2**30)
        print(f"{log.stat().st_size / 2**30:.2f} GiB, {rows:,} rows", flush=True)
        begin = time.monotonic()
        words = [sys.executable, "-m", "experiments.import_logs", "--format=csv"]
        words += [f"--input={log}", f"--source={toml}", f"--output={folder / 'data'}"]
        words += [f"--stride={_STRIDE.value}", f"--workers={_WORKERS.value}"]
        words += ["--keep_steady", "--keep_free_road"]
        process = subprocess.Popen(
            words, env={**os.environ, "TMPDIR": place, "JAX_PLATFORMS": "cpu"}
        )
        watch = Watch(process.pid)
        watch.start()
        if process.wait() != 0:
            sys.exit(process.returncode)
        seconds = time.monotonic() - begin
        manifest = json.loads((folder / "data" / "manifest.json").read_text())
        scenes = manifest["quality"]["scenes"]
        found = {
            "gigabytes": log.stat().st_size / 2**30,
            "rows": rows,
            "stride_s": _STRIDE.value,
            "scenes": scenes,
            "seconds": seconds,
            "scenes_per_s": scenes / seconds,
            "rows_per_s": rows / seconds,
            "peak_gib_main": watch.one / 2**10,
            "peak_gib_with_workers": watch.all / 2**10,
            "workers": _WORKERS.value,
        }
    print(json.dumps(found, indent=2))
    write("long_log", found, _OUTPUT.value)


if __name__ == "__main__":
    run(main)
