"""Sets finished tuning runs side by side, as a page.

    python -m experiments.report --runs=RUN,RUN --output=compare.html

The page says what each run was decided, which settings and data differ, and how its
numbers compare, with their intervals. `rcirl report` draws the page of one run again.
Needs the extra [report].
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance, run
from rcirl_jax.report.compare import read_run, write_comparison

_RUNS = flags.DEFINE_list("runs", None, "folders of tuning runs", required=True)
_OUTPUT = flags.DEFINE_string("output", "compare.html", "page to write")


def main() -> None:
    """Reads the runs and draws one page."""
    runs = [read_run(Path(folder)) for folder in _RUNS.value]
    page = write_comparison(Path(_OUTPUT.value), runs, provenance())
    print(f"page to open: {page}")


if __name__ == "__main__":
    run(main)
