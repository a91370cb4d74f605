"""Several tuning runs side by side, as a page.

    rcirl compare --runs=RUN,RUN --output=compare.html
    rcirl compare RUN RUN --output=compare.html

RUN is a folder of `rcirl autotune`, finished up to its verdict. The page says what each
was decided, which settings and data differ, and how its numbers compare, with their
intervals. Nothing in the runs is changed; one with a file that was edited since is
refused. Needs the extra [report].
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance
from rcirl_jax.errors import InputError

USUAL = ("runs", "output")
ARGUMENTS = "runs"  # the flag that takes arguments without a name
_RUNS = flags.DEFINE_list(
    "runs",
    None,
    "folders of `rcirl autotune`, two or more, with commas or without --runs",
)
_OUTPUT = flags.DEFINE_string("output", "compare.html", "page to write")


def main() -> None:
    """Folders of runs -> one page."""
    from rcirl_jax.report.compare import read_run, write_comparison

    folders = [Path(name) for name in _RUNS.value or ()]
    if len(folders) < 2:
        raise InputError(
            f"--runs: {len(folders)} given: expected two folders of `rcirl autotune` "
            "or more"
        )
    runs = [read_run(one) for one in folders]
    page = write_comparison(Path(_OUTPUT.value), runs, provenance())
    print(f"written: {page}")
