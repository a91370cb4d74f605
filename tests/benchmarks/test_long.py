"""The long rows of docs/reliability.md, each by its command: `make test-long`."""

import pytest
from absl import flags
from absl.testing import flagsaver

from benchmarks.reliability import table

LONG = [
    row
    for row in table.rows_of(table.PAGE.read_text())
    if row.command.startswith("python ") or row.command == "make fuzz"
]
pytestmark = [pytest.mark.slow, pytest.mark.long, pytest.mark.multiprocess]


@pytest.mark.parametrize("row", LONG, ids=lambda row: row.fault[:40])
def test_a_long_row_comes_out_as_stated(row, tmp_path):
    flags.FLAGS(["table"])
    with flagsaver.flagsaver(output=str(tmp_path)):
        result = table.ran(row)
    assert result["status"] == 0, result["said"]
