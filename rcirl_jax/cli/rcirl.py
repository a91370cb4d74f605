"""The command `rcirl`: a sub-command is a module of this package with a `main`.

A module defines its flags with absl, which knows one flag of a name in a process: only
the module that is asked for is imported. This one imports neither absl nor JAX.
"""

import contextlib
import importlib
import os
import signal
import sys

from rcirl_jax import __version__
from rcirl_jax.errors import did_you_mean

# sub-command -> module of this package, one line of help
COMMANDS = {
    "autotune": ("autotune", "the whole loop: from logs to a verdict and its report"),
    "import": ("import_logs", "recorded driving -> a dataset of scenes"),
    "inspect": ("inspect_data", "look at a dataset: a picture per scene, its quality"),
    "train": ("train", "learn a reward from a dataset"),
    "sweep": ("sweep", "train a grid of rewards, choose by held-out scenes"),
    "export": ("export_weights", "a trained run -> weights; ONNX, StableHLO, YAML"),
    "rank": ("rank", "rank held-out scenes, beside all baselines"),
    "simulate": ("simulate", "drive the closed-loop suite, beside baselines"),
    "gate": ("gate", "may a candidate replace what drives today?"),
    "replay": ("replay", "drive one case again, as a page that plays it"),
    "report": ("report", "draw the page of an autotune run again"),
    "compare": ("compare", "several autotune runs side by side, as a page"),
    "human-likeness": (
        "human_likeness",
        "compare learners: who chooses most like a human?",
    ),
    "drive-elsewhere": (
        "drive_elsewhere",
        "drive in simulators that others wrote: highway-env, SUMO, CommonRoad",
    ),
}
HEAD = """Learn a motion planner's reward from recorded human driving.

    rcirl autotune --input=LOGS --output=RUN     from logs to a verdict and its report
    rcirl COMMAND --help                         its usual flags
    rcirl COMMAND --helpfull                     all its flags
"""
TAIL = """
--flagfile=FILE reads flags from a file, one a line. Bad input ends with one line and
status 2, SIGTERM and Ctrl-C with 143 and 130: run the same command to go on."""
HELP = ("help", "-h", "-help", "--help", "--helpfull", "--helpshort")


def overview() -> str:
    """The text of `rcirl --help`."""
    lines = [f"  {name:16}{line}" for name, (_, line) in COMMANDS.items()]
    return "\n".join([HEAD, "commands:", *lines, TAIL])


def main() -> None:
    """`rcirl SUB --flags`: import the module of SUB, and run its main."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in HELP or name == "--version":
        text = f"rcirl-jax {__version__}" if name == "--version" else overview()
        with contextlib.suppress(BrokenPipeError):  # nobody reads on, behind `| head`
            print(text, flush=True)
            return
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)
    if name not in COMMANDS:
        hint = did_you_mean(name, COMMANDS)
        print(
            f"error: {name}: unknown: expected one of {', '.join(COMMANDS)}{hint}",
            file=sys.stderr,
        )
        sys.exit(2)
    sys.argv[:] = [f"rcirl {name}", *rest]
    running = importlib.import_module("rcirl_jax.cli.running")
    module = importlib.import_module(f"rcirl_jax.cli.{COMMANDS[name][0]}")
    running.run(module.main)
