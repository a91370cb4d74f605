"""docs/preferences.md: its file is read, its script asks and writes one."""

import json
import os
import subprocess
import sys

import jax
import numpy as np

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.preferences import read_preferences
from rcirl_jax.data.store.writer import DatasetWriter
from rcirl_jax.units import HORIZON_S
from tests.data.store.test_dataset import finish_fields, lineage
from tests.docs.pages import DOCS, REPO, fences
from tests.helpers.scenes import batch, demonstration

PAGE = (DOCS / "preferences.md").read_text()
FILES = {title: content for _, title, content in fences(PAGE) if title}
COUNT = 4


def stored(folder):
    rows = jax.tree.map(np.asarray, batch([demonstration(i) for i in range(COUNT)]))
    writer = DatasetWriter(folder)
    rows = rows.replace(future_s=np.full(COUNT, HORIZON_S, np.float32))
    writer.write_shard(0, rows, lineage(0))
    writer.finish(finish_fields())
    return open_dataset(folder)


def test_the_file_of_the_page_is_read(tmp_path):
    data = stored(tmp_path / "d")
    text, row = FILES["judged.jsonl"], int(data.indices("train")[0])
    for number in ("17", "40"):
        text = text.replace(f'"scene": {number}', f'"scene": {row}')
    (tmp_path / "judged.jsonl").write_text(text.replace("HASH", data.hash))
    found = read_preferences(tmp_path / "judged.jsonl", data)
    assert found.weight.tolist() == [1.0, 2.0]
    assert found.s[1, 0, -1] == 22.0
    np.testing.assert_array_equal(found.s[0, 0], found.s[1, 1])  # the human


def test_the_script_of_the_page_asks_and_writes(tmp_path):
    data = stored(tmp_path / "d")
    (tmp_path / "judge.py").write_text(FILES["judge.py"])
    rows = ",".join(map(str, data.indices("train")[:2]))
    compiled = {k: v for k, v in os.environ.items() if k.startswith(("JAX_", "XLA_"))}
    env = {**compiled, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(REPO), "PATH": ""}
    done = subprocess.run(
        [sys.executable, "judge.py", "d", rows, "judged.jsonl"], input="a\nb\n",
        cwd=tmp_path, env=env,
        text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("better (a or b): ") == 2
    lines = [
        json.loads(x) for x in (tmp_path / "judged.jsonl").read_text().splitlines()
    ]
    found = read_preferences(tmp_path / "judged.jsonl", data)
    assert found.row.tolist() == data.indices("train")[:2].tolist()
    # what was answered is what was written: a of the first, b of the second
    assert f"{lines[1]['better']['s'][-1]:.0f} m in 8 s" in done.stdout.split("a: ")[1]
    assert f"{lines[2]['better']['s'][-1]:.0f} m in 8 s" in done.stdout.split("b: ")[2]
