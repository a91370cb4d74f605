"""The command `rcirl`: its sub-commands, their help, flags that are not given."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rcirl_jax import __version__
from rcirl_jax.cli.flags import left_out
from rcirl_jax.cli.rcirl import COMMANDS, overview
from rcirl_jax.errors import InputError
from rcirl_jax.tuning.recipes import DEFAULT, load_recipe
from tests.helpers.commands import command, python, refused, succeeded

LINES, COLUMNS = 40, 100  # of a screen
FLAG = re.compile(r"^  --(?:\[no\])?([a-z_0-9]+)", re.M)
# a required flag by the command that wants it
REQUIRED = {
    "autotune": "output",
    "inspect": "data, --output",
    "train": "data, --output",
    "sweep": "data, --output",
    "rank": "weights, --data",
    "simulate": "output",
    "gate": "candidate, --output",
    "replay": "case, --output",
    "report": "run",
    "human-likeness": "data",
    "drive-elsewhere": "simulator, --weights, --output",
}
# Help of every command, and what it says where no flag is given, in one process that
# has what an installation without extras has; absl knows one flag of a name
EVERY = """
import importlib, json, sys
from absl import flags
from rcirl_jax.cli.rcirl import COMMANDS
OPTIONAL = {
    "defusedxml", "flatbuffers", "google_crc32c", "jinja2", "markupsafe", "matplotlib",
    "mcap", "mcap_ros2", "onnx", "optuna", "pyarrow", "pyproj", "ray", "shapely",
    "tensorboardX",
}
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in OPTIONAL:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Without())
OURS, found = "rcirl_jax.cli", {}
for name, (module, _) in COMMANDS.items():
    for flag in list(flags.FLAGS):
        if flags.FLAGS.find_module_defining_flag(flag, "").startswith(OURS):
            delattr(flags.FLAGS, flag)
    for old in [old for old in sys.modules if old.startswith(OURS)]:
        del sys.modules[old]
    main = importlib.import_module(f"{OURS}.{module}").main
    running = importlib.import_module(f"{OURS}.running")
    helps = [running.asked_for(["rcirl", x], main) for x in ("--help", "--helpfull")]
    try:
        flags.FLAGS(["rcirl"])
        missing = ""
    except flags.Error as error:
        missing = running.complaint(error, main)
    found[name] = [*helps, missing]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def every():
    """Command -> what --help and --helpfull say, and what is said without flags."""
    done = python(EVERY)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def fits(text):
    lines = text.splitlines()
    return len(lines) <= LINES and all(len(line) <= COLUMNS for line in lines)


def test_the_overview_fits_and_names_every_command():
    assert fits(overview())
    for name, (_, line) in COMMANDS.items():
        assert f"  {name:16}{line}" in overview()


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_and_has_the_usual_flags_only(name, every):
    short, full, _ = every[name]
    assert fits(short), short
    assert not re.search(r"\w;? {2,}\w", re.sub(FLAG, "", full)), full
    assert f"    rcirl {name} --" in short
    usual, flags = FLAG.findall(short), FLAG.findall(full)
    assert flags[: len(usual)] == usual
    assert len(set(flags)) == len(flags)
    (hidden,) = re.findall(r"--helpfull shows (\d+) more", short) or ["0"]
    assert len(flags) == len(usual) + int(hidden)
    assert "--flagfile=FILE" in short
    assert "--flagfile=FILE" in full


def test_defaults_are_those_of_the_recipe(every):
    for name in ("train", "autotune", "import", "sweep", "human-likeness"):
        assert "the recipe's" not in every[name][1]
    full = " ".join(every["train"][1].split())
    tuned = load_recipe(DEFAULT).train
    hidden = ",".join(map(str, tuned.reward.hidden))
    wanted = {"learning_rate": tuned.learning_rate, "hidden_size": hidden}
    for flag, value in {**wanted, "loss": tuned.loss, "mode": "speed"}.items():
        assert re.search(rf"--{flag} [^()]*\(default: {value}, of the recipe", full)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_flag_that_is_missing_is_named_with_an_example(name, every):
    line = every[name][2]
    if name not in REQUIRED:
        assert line == ""
        return
    assert line.startswith(f"--{REQUIRED[name]}: not given: expected ")
    assert f"; for example: rcirl {name} --" in line
    assert "\n" not in line


@pytest.mark.multiprocess
def test_no_flag_of_absl_ends_a_gate_before_its_verdict(tmp_path):
    """Also from a file: status 0 of a gate means "ship" and nothing else."""
    (tmp_path / "flags").write_text("--helpxml\n")
    given = ("gate", "--candidate=none", f"--output={tmp_path}/verdict.json")
    for flag, last in (
        ("only_check_args", "--only_check_args"),
        ("helpxml", f"--flagfile={tmp_path}/flags"),
    ):
        assert f"--{flag}=true: expected a flag" in refused("rcirl_jax", *given, last)


@pytest.mark.multiprocess
def test_the_package_is_the_command():
    assert "rcirl rank" in command("rcirl_jax", "rank", "--help").stdout
    assert succeeded("rcirl_jax", "--help").stdout.strip() == overview()
    assert succeeded("rcirl_jax", "--version").stdout.strip().endswith(__version__)


# A command of our own
MAIN = """
from rcirl_jax.cli.running import run
def main():
    {}
run(main)
"""
PRINTS = MAIN.format('print("x" * 100_000)')  # more than a buffer holds


@pytest.mark.parametrize(
    ("words", "joined"),
    [(["-m", "rcirl_jax", "train", "--helpfull"], False), (["-c", PRINTS], True)],
    ids=["help", "main"],
)
def test_output_that_nobody_reads_ends_without_a_word(words, joined):
    """As behind `| head`."""
    unread, output = os.pipe()
    os.close(unread)
    done = subprocess.run(
        [sys.executable, *words],
        stdout=output, stderr=output if joined else subprocess.PIPE, check=False,
    )  # fmt: skip
    os.close(output)
    assert (done.returncode, done.stderr or b"") == (128 + signal.SIGPIPE, b"")


def test_output_without_room_is_one_line():
    with Path("/dev/full").open("w") as full:
        done = python(PRINTS, capture_output=False, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert "No space left on device" in line


def test_a_fault_is_a_traceback_and_a_line_on_reporting_it():
    done = python(MAIN.format('raise ZeroDivisionError("scene 7")'))
    assert done.returncode == 70
    *above, said = done.stderr.splitlines()
    assert above[0].startswith("Traceback")
    assert above[-1] == "ZeroDivisionError: scene 7"
    assert said.startswith("error: this is a fault of rcirl-jax, not of your input")


def test_a_missing_extra_is_one_line_that_names_it():
    missing = 'raise ModuleNotFoundError("none", name="matplotlib.axes")'
    done = python(MAIN.format(missing))
    assert done.returncode == 2
    line = "error: matplotlib: not installed: expected pip install 'rcirl-jax[report]'"
    assert done.stderr.strip() == line


@pytest.mark.parametrize(
    ("text", "found"), [("0", (0, 0.0)), ("3", (3, 0.0)), ("5%", (0, 0.05))]
)
def test_a_count_or_a_share_is_left_out(text, found):
    assert left_out(text) == found


@pytest.mark.parametrize("text", ["-1", "100%", "nan%", ""])
def test_other_words_are_refused(text):
    with pytest.raises(InputError, match=r"--leave_out: .*expected a count"):
        left_out(text)
