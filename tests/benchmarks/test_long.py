"""The long rows of docs/reliability.md, each by its command: `make test-long`."""

import pytest

from benchmarks.reliability import table

LONG = [
    row
    for row in table.rows_of(table.PAGE.read_text())
    if row.command.startswith("python ") or row.command == "make fuzz"
]
pytestmark = [pytest.mark.slow, pytest.mark.long, pytest.mark.multiprocess]


@pytest.mark.parametrize("row", LONG, ids=lambda row: row.fault[:40])
def test_a_long_row_comes_out_as_stated(row, tmp_path):
    result = table.ran(row, str(tmp_path))
    assert result["status"] == 0, result["said"]
