"""Makes the files of benchmarks/results that docs/results.md cites, cheapest first.

    make results    # all, from out/us101, out/urban and out/i80
    python -m benchmarks.remake --us101=DATA --parts=optimisers,discount_factors
    python -m benchmarks.remake --check

What today's code has made is left as it is, so a killed run goes on where it was. What
is left, and how many hours of two quiet cores that takes, is said before the first
command runs. `--check` only says which files are missing or of other code. Speed is
made by `make bench`, faults by `make reliability`.
"""

import dataclasses
import json
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import run
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json, write_whole
from rcirl_jax.runtime.pipeline import code_sha256

RESULTS = Path(__file__).parent / "results"
SITES = ("us101", "urban", "i80")
_SITES = {
    name: flags.DEFINE_string(name, f"out/{name}", f"dataset of {name}")
    for name in SITES
}
_OUTPUT = flags.DEFINE_string("made_in", "out/results", "folder of the runs")
_RESULTS = flags.DEFINE_string("kept_in", str(RESULTS), "folder of the JSONs")
_RECORDINGS = flags.DEFINE_string(
    "recordings", "../shared/data", "folder of the recordings, for the labels"
)
_ONLY = flags.DEFINE_list("parts", [], "commands by name; all if empty")
_CHECK = flags.DEFINE_bool("check", False, "only say what is missing or of other code")


@dataclasses.dataclass(frozen=True)
class Command:
    """A command and its files; {out} is a folder of its own, {NAME} a dataset."""

    name: str
    minutes: int  # of two quiet cores
    line: str  # after `python -m`; several with " && "
    files: dict[str, str]  # file of benchmarks/results -> what it is in the folder
    after: str = ""  # the command whose folder {after} it reads


LEARNERS = (
    "RC-IRL rank,RC-IRL rank on curves,RC-IRL logistic,logistic free,MaxEnt,"
    "MaxEnt 32-16,MaxEnt monotone 32-16,GAN,GAN free,logistic linear,"
    "logistic non-negative,logistic 32-16"
)
DIALS = ",".join(  # of the chain: its gain times these, and its own
    f"{{after}}/{file}.msgpack"
    for file in ("dials/0.25", "dials/0.5", "weights", "dials/2", "dials/4")
)
THREE = "--data={us101},{urban},{i80} --output={out}"
COMMANDS = (
    Command(
        "background_shift",
        1,
        "experiments.paper.background_shift --output={out}",
        {"background_shift": "background_shift.json"},
    ),
    Command(
        "labels",
        10,
        "benchmarks.labels --data={recordings} --output={out}",
        {"label_scenes": "labels.json"},
    ),
    Command(
        "artefact_audit",
        10,
        "experiments.paper.artefact_audit --data={us101} --output={out}",
        {"artefact_audit": "artefact_audit.json"},
    ),
    *(
        Command(
            f"human_likeness_{site}",
            minutes,
            f"rcirl_jax human-likeness --data={{{site}}} --output={{out}} --seeds=5 "
            f"--tuned=3 --tuned_long=3000 --learners='{LEARNERS}'",
            {f"human_likeness_{site}": "ranking.json"},
        )
        for site, minutes in (("urban", 15), ("us101", 25), ("i80", 60))
    ),
    Command(
        "rank_against_gan_paper",
        30,
        f"experiments.paper.rank_against_gan {THREE} --recipe=paper --losses=rank,gan "
        "--seeds=5 --steps=1000",
        {"rank_against_gan_paper": "rank_against_gan.json"},
    ),
    Command(
        "optimisers",
        60,
        "experiments.paper.optimisers --data={us101} --output={out} --steps=1000 "
        "--seeds=5 --recipe=paper",
        {"optimisers": "optimisers.json"},
    ),
    Command(
        "discount_factors",
        40,
        "experiments.paper.discount_factors --data={us101} --output={out} --steps=1000 "
        "--seeds=5 --recipe=paper",
        {"discount_factors": "discount_factors.json"},
    ),
    Command(
        "left_out_site",
        40,
        "experiments.paper.left_out_site --output={out} "
        "--sites=us101={us101},urban={urban},i80={i80}",
        {"left_out_site": "left_out_site.json"},
    ),
    Command(
        "leaky_rate_and_hidden_size",
        40,
        "rcirl_jax sweep --data={us101} --output={out} --recipe=paper "
        "--leaky_rates=0.01,0.05,0.2,0.5 --hidden_sizes=5,15,45 --seeds=5",
        {"leaky_rate_and_hidden_size": "sweep.json"},
    ),
    Command(
        "gate_errors",
        60,
        "experiments.gate_errors --output={out}/gate_errors.json",
        {"gate_errors_constructed": "gate_errors.json"},
    ),
    Command(
        "own_terms",
        75,
        f"rcirl_jax autotune {THREE} --terms=benchmarks/frenetix_terms.py:TERMS "
        "--cases=10 --duration=60",
        {
            "own_terms_ranking": "ranking.json",
            "own_terms_likeness": "likeness.json",
            "own_terms_suite": "suite/suite.json",
            "own_terms_verdict": "verdict.json",
        },
    ),
    Command(
        "chain",
        120,
        f"rcirl_jax autotune {THREE} --workers=2",
        {
            "chain_ranking": "ranking.json",
            "chain_ranking_recorded": "ranking_recorded.json",
            "chain_likeness": "likeness.json",
            "chain_suite": "suite/suite.json",
            "chain_verdict": "verdict.json",
            "chain_decided": "decided.json",
            "chain_dial": "dial.json",
        },
    ),
    Command(
        "dial_ranking",
        2,
        f"rcirl_jax rank --weights={DIALS} --data={{us101}},{{urban}},{{i80}} "
        "--output={out}/ranking.json",
        {"dial_ranking": "ranking.json"},
        after="chain",
    ),
    Command(
        "gains",
        15,
        f"rcirl_jax simulate --weights={DIALS} --suite=full --cases=10 "
        "--catalogue_seed=1 --baselines=hand-set --output={out}",
        {"gains": "suite.json"},
        after="chain",
    ),
    Command(
        "verdict_gain_1",  # a third above the recipe's gain
        60,
        "rcirl_jax export --weights={after}/weights.msgpack --dial=1.33333333 "
        "--output={out}/weights.msgpack && "
        "rcirl_jax gate --candidate={out}/weights.msgpack --incumbent=hand-set "
        "--tuned_idm={after}/tuned_idm.json --data={us101},{urban},{i80} --workers=2 "
        "--output={out}/verdict.json",
        {"verdict_gain_1": "verdict.json"},
        after="chain",
    ),
    *(
        Command(
            f"elsewhere_{name}",
            30,
            f"rcirl_jax drive-elsewhere --simulator={name} {seconds}--episodes=500 "
            "--weights={after}/weights.msgpack --output={out}",
            {f"elsewhere_{name}": "elsewhere.json"},
            after="chain",
        )
        for name, seconds in (("highway_env", "--seconds=20 "), ("sumo", ""))
    ),
    Command(
        "search",
        30,
        "rcirl_jax simulate --weights={after}/weights.msgpack --dp --suite=full "
        "--cases=2 --duration=60 --baselines=hand-set --output={out}",
        {"search": "suite.json"},
        after="chain",
    ),
)
DIGITS = 5  # that count of a number


def rounded(x: object) -> object:
    """The same JSON with numbers of a few digits."""
    if isinstance(x, dict):
        return {key: rounded(value) for key, value in x.items()}
    if isinstance(x, list):
        return [rounded(value) for value in x]
    return float(f"{x:.{DIGITS}g}") if isinstance(x, float) else x


def made_of(path: Path) -> str:
    """Returns "" for a file that today's code made, else what is wrong with it."""
    if not path.is_file():
        return "missing"
    code = read_json(path, "JSON").get("made_by", {}).get("code_sha256")
    return "" if code == code_sha256() else "of other code"


def left_of(commands: Sequence[Command], results: Path) -> dict[str, list[str]]:
    """Command -> its files that are missing or of other code, cheapest first."""
    found: dict[str, list[str]] = {}
    for command in sorted(commands, key=lambda x: (bool(x.after), x.minutes)):
        wrong = {file: made_of(results / f"{file}.json") for file in command.files}
        if said := [f"{file}.json {why}" for file, why in wrong.items() if why]:
            found[command.name] = said
    return found


def make(
    command: Command, folder: Path, results: Path, places: Mapping[str, str]
) -> None:
    """Run a command and keep its files.

    Args:
      command: whose folder is `folder`/NAME.
      folder: of all runs.
      results: folder of the JSONs.
      places: of the datasets and recordings, by name.
    """
    out = folder / command.name
    lines = command.line.format(out=out, after=folder / command.after, **places)
    for line in lines.split(" && "):
        print(f"python -m {line}", flush=True)
        done = subprocess.run([sys.executable, "-m", *shlex.split(line)], check=False)
        if done.returncode:
            raise InputError(
                f"{command.name}: its command ended with status {done.returncode}, for "
                "the reason above; run it again to go on"
            )
    for file, made in command.files.items():
        body = rounded(json.loads((out / made).read_text()))
        write_whole(results / f"{file}.json", json.dumps(body, indent=1) + "\n")


def main() -> None:
    """Says what is left, and makes it."""
    known = {command.name: command for command in COMMANDS}
    for name in _ONLY.value:
        if name not in known:
            raise InputError(f"parts: {name}: unknown: expected {', '.join(known)}")
    asked = [known[name] for name in _ONLY.value or known]
    results = Path(_RESULTS.value)
    left = left_of(asked, results)
    for name, said in left.items():
        print(f"{name}, about {known[name].minutes} min: {', '.join(said)}")
    hours = sum(known[name].minutes for name in left) / 60.0
    print(f"{len(left)} of {len(asked)} commands are left, about {hours:.1f} h")
    if _CHECK.value:
        return
    places = {name: flag.value for name, flag in _SITES.items()}
    places["recordings"] = _RECORDINGS.value
    for name in left:
        start = time.monotonic()
        make(known[name], Path(_OUTPUT.value), results, places)
        print(f"{name}: {(time.monotonic() - start) / 60.0:.0f} min", flush=True)


if __name__ == "__main__":
    run(main)
