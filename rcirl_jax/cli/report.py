"""Draw the page of a tuning run again, as this version draws it.

    rcirl report --run=RUN [--output=report.html]

RUN is of `rcirl autotune`, finished up to its verdict. Its settings and sources are
those that RUN/stages.json has noted; nothing but RUN/report.html, and its copy
--output, is made. Needs the extra [report].
"""

from collections.abc import Mapping
from pathlib import Path

from absl import flags

from rcirl_jax.cli import autotune
from rcirl_jax.cli.flags import undefine_flags
from rcirl_jax.errors import MALFORMED, InputError
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.runtime.pipeline import FILE, Stages, only_one
from rcirl_jax.tuning.loop import draw_again

undefine_flags("output")  # of autotune
USUAL = ("run", "output")
_RUN = flags.DEFINE_string(
    "run", None, "folder of `rcirl autotune`, with its verdict", required=True
)
_OUTPUT = flags.DEFINE_string("output", None, "a copy of RUN/report.html to write")

# what is noted of a run and is not set again
NOT_OF_A_RUN = (*("output", "executor", "workers", "ray_address", "compilation_cache"),)


def recall(folder: Path) -> None:
    """Set the flags of `rcirl autotune` to those of a run's verdict.

    Raises:
      InputError: no such run, or a flag was given that the run's would replace.
    """
    where, known = folder / FILE, Stages(folder=folder).read()
    if "gate" not in known:
        raise InputError(f"{where}: gate: missing: expected a run with its verdict")
    noted = known["gate"].get("made_by")
    found = noted.get("flags") if isinstance(noted, Mapping) else None
    if not isinstance(found, Mapping):
        raise InputError(f"{where}: gate: made_by.flags: expected the run's flags")
    for name, value in found.items():
        if name in NOT_OF_A_RUN or name not in flags.FLAGS:
            continue
        flag = flags.FLAGS[name]
        if flag.present:
            raise InputError(f"--{name}: expected none: the run's own is taken")
        try:
            own = None if value is None else flag.parser.parse(value)
            setattr(flags.FLAGS, name, own)
        except (*MALFORMED, flags.Error) as error:
            raise InputError(f"{where}: gate: --{name}: {error}") from error


def main() -> None:
    """The run's flags -> its page."""
    folder = Path(_RUN.value)
    recall(folder)
    with only_one(folder):
        made = autotune.made_run(folder)
        draw_again(made, autotune.sources())
    if _OUTPUT.value:
        write_whole(Path(_OUTPUT.value), made.page.read_bytes())
