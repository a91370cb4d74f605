"""Precision and recall of the automatic labels on scenes that a person judged.

    python -m benchmarks.labels --data=FOLDER --output=DIR

FOLDER has the recordings of the sites that benchmarks/judged_scenes.json names. They
are read and cut anew, as an import does it. Minutes.
"""

from pathlib import Path

from absl import app, flags

from benchmarks.common import write
from benchmarks.judged import compare, read_verdicts, scores

_DATA = flags.DEFINE_string("data", "../shared/data", "folder of the recordings")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


def main(_: list[str]) -> None:
    """Compare, print, write."""
    table = scores(compare(read_verdicts(), Path(_DATA.value)))
    for batch, rows in table.items():
        print(f"{batch:<10}{'true':>6}{'precision, %':>24}{'recall, %':>24}")
        for row in rows:
            print(f"{row['name']:<10}{row['true']:>6}", end="")
            for rate in (row["precision"], row["recall"]):
                shown = [f"{100.0 * x:.1f}" for x in rate or ()]
                text = "{} [{}, {}]".format(*shown) if shown else "-"
                print(f"{text:>24}", end="")
            print()
    write("labels", {"judged": table}, _OUTPUT.value)


if __name__ == "__main__":
    app.run(main)
