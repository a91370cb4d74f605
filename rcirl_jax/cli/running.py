"""The frame of every command: help, flags, one line on bad input, provenance.

`run` is the frame of every main. Bad input, a place that cannot be written and memory
that is not given end with one line and status 2; a fault of this package with its
traceback, a line on reporting it, and status 70; SIGTERM with 143, SIGINT with 130.
"""

import contextlib
import functools
import inspect
import os
import re
import select
import signal
import sys
import textwrap
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import ModuleType
from typing import NoReturn, TextIO

import jax
from absl import app, flags, logging

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError, did_you_mean, extra_of
from rcirl_jax.export.reader import load_weights
from rcirl_jax.planner import own_cost
from rcirl_jax.runtime import provenance as made_by
from rcirl_jax.runtime import signals as interrupts
from rcirl_jax.runtime.atomic_files import is_text
from rcirl_jax.runtime.compiling import use_cache

EXIT_BAD_INPUT = 2
EXIT_FAULT = 70  # of this program, as sysexits.h has it
FAULT = (
    "this is a fault of rcirl-jax, not of your input: please report the lines above "
    "as CONTRIBUTING.md says"
)
NO_MEMORY = "RESOURCE_EXHAUSTED"  # how JAX's errors begin that come of its want
# arguments of the library that flags call otherwise
FLAG_OF = {
    "duration_s": "duration",
    "hidden": "hidden_size",
    "horizon_s": "horizon",
    "preset": "features",
    "recordings": "traffic",
    "track": "filter",
}
AS_SAID = " (default: the recipe's)"  # of a flag beside a recipe; help shows its value
HEADINGS: dict[str, str] = {}  # in `--helpfull`, by the name of a shared flag
OURS = ("rcirl_jax.cli.", "experiments.")  # modules whose flags are a command's
SHORT = ("-h", "-?", "-help", "--help", "--helpshort")
FULL = ("-helpfull", "--helpfull")
WIDTH, INDENT = 100, 20  # columns of help
LONGEST = 40  # characters of a default
# flags of absl that end a command before its work, with status 0 or 1
ENDING = ("only_check_args", "only_check_flags", "helpxml")
FROM_FILE = "--flagfile=FILE reads flags from a file, one a line."
flags.DEFINE_bool(
    "compilation_cache",
    True,
    "keep compiled programs in the user's folder of caches, 2 GiB at most",
)


def run(main: Callable[[], None]) -> None:
    """Parses the flags, runs a command and ends the process with its status.

    Args:
      main: of a module whose docstring is its help. The module may have `USUAL`, the
        flags that `--help` shows, and `ARGUMENTS`, the flag of words without a name.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    logging.set_verbosity(logging.WARNING)

    def guarded(argv: list[str]) -> None:
        try:
            _take(argv[1:], main)
            if flags.FLAGS["compilation_cache"].value:
                use_cache()
            main()
        except InputError as error:
            _refuse(with_flags(str(error)))
        except BrokenPipeError:
            raise
        except OSError as error:
            _refuse(_about(error))
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            if line := own_cost.failure(error):
                _refuse(line)
            why = " ".join(str(error).split())[:200]
            if not isinstance(error, MemoryError) and not why.startswith(NO_MEMORY):
                _fault(error)
            _refuse(f"memory: {why or 'refused'}: expected more for this work")
        except interrupts.Interrupted as stop:
            if jax.distributed.is_initialized():  # others are told goodbye first
                sys.exit(128 + stop.number)
            interrupts.leave(stop.number)
        except Exception as error:
            if known := extra_of(error):
                _refuse(known)
            _fault(error)

    interrupts.install()
    with _while_read():
        app.run(guarded, flags_parser=functools.partial(_parse, main))


@contextlib.contextmanager
def _while_read() -> Iterator[None]:
    """Ends without a word where nobody reads the output, as behind `| head`."""
    try:
        try:
            yield
        except SystemExit as stop:
            if sys.stdout is not None:
                _flush(sys.stdout, stop.code)
            raise
    except BrokenPipeError as error:
        unread = [x for x in (sys.stdout, sys.stderr) if x is not None and _unread(x)]
        if not unread:
            _refuse(_about(error))  # of another pipe
        for stream in unread:
            _drop(stream)
        sys.exit(128 + signal.SIGPIPE)
    except OSError as error:
        _refuse(_about(error))


def _flush(output: TextIO, status: object) -> None:
    """Writes what is left of the output; an OSError unless an error was said before."""
    try:
        output.flush()
    except BrokenPipeError:
        raise
    except OSError:  # no room
        _drop(output)
        if not status:
            raise


def _unread(stream: TextIO) -> bool:
    """True for a pipe or socket whose other end is closed."""
    poll = select.poll()
    try:
        poll.register(stream.fileno(), 0)  # errors are told without asking
    except (OSError, ValueError):  # it is no file
        return False
    return bool(poll.poll(0))


def _drop(stream: TextIO) -> None:
    """Lets what the stream still holds go nowhere when Python ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _refuse(what: object, status: int = EXIT_BAD_INPUT) -> NoReturn:
    """Prints one line on stderr and ends with the status."""
    print(f"error: {what}", file=sys.stderr)
    sys.exit(status)


def _fault(error: Exception) -> NoReturn:
    """Prints the traceback of an error that nothing foresaw, and what to do with it."""
    traceback.print_exception(error)
    _refuse(FAULT, EXIT_FAULT)


def _about(error: OSError) -> str:
    """One line: the file, if the system told it, and the reason."""
    known = error.filename is not None and error.strerror is not None
    text = f"{error.filename}: {error.strerror}" if known else str(error)
    return " ".join(text.split())


def with_flags(message: str) -> str:
    """Puts dashes before an argument of the library that a flag has set."""
    names = message.partition(": ")[0]
    found = [flag_of(name) for name in names.split(", ")]
    if not all(found):
        return message
    return ", ".join(f"--{flag}" for flag in found) + message.removeprefix(names)


def flag_of(argument: str) -> str | None:
    """Returns the flag that sets an argument of the library, None without one."""
    for name in (argument, FLAG_OF.get(argument, ""), f"{argument}_margin"):
        if name in flags.FLAGS:
            return name
    return None


class _Unknown(flags.ArgumentParser):
    """Refuses every value: of flags that no command has."""

    def parse(self, argument: object) -> NoReturn:
        raise ValueError("expected a flag of the command")


def _parse(main: Callable, argv: list[str]) -> list[str]:
    """Parses flags as absl does, with our help, and its complaints as one line.

    Names of files that are no UTF-8 could not be written into what is made of them.
    """
    odd = [text for text in argv if not is_text(text)]
    if odd:
        _refuse(f"{odd[0]!a}: expected UTF-8")
    if text := asked_for(argv, main):
        print(text)
        sys.exit(0)
    for name in ENDING:
        if name in flags.FLAGS:  # a newer absl has more of them
            flags.FLAGS[name].parser = _Unknown()
    try:
        return flags.FLAGS(argv)
    except flags.Error as error:
        _refuse(complaint(error, main))


def complaint(error: flags.Error, main: Callable) -> str:
    """One line on required flags that are missing, or a value that a flag cannot have.

    Args:
      error: of absl; those of values say "flag --NAME=VALUE: why".
      main: of the command, whose docstring has an example.
    """
    cause = error.__context__
    if isinstance(error, flags.CantOpenFlagFileError) and isinstance(cause, OSError):
        return f"--flagfile: {_about(cause)}: expected a file of flags, one a line"
    found = re.findall(r"^flag --(\w+)=(.*?): (.*)$", str(error), re.M)
    missing = [name for name, value, _ in found if value == "None"]
    if missing:
        wanted = "; ".join(str(flags.FLAGS[name].help) for name in missing)
        names = ", ".join(f"--{name}" for name in missing)
        shown = example(module_of(main))
        given = f"{names}: not given: expected {wanted}"
        return f"{given}; for example: {shown}" if shown else given
    for name, value, why in found:
        parser = flags.FLAGS[name].parser
        if known := getattr(parser, "enum_values", ()):
            hint = did_you_mean(value, known)
            return f"--{name}: {value}: expected one of {', '.join(known)}{hint}"
        if parser.syntactic_help and not why.startswith("expected"):
            return f"--{name}: {value}: expected {parser.syntactic_help}"
    return " ".join(str(error).split())


def _take(words: list[str], main: Callable) -> None:
    """Sets the flag that a command calls `ARGUMENTS` to words without a name."""
    if not words:
        return
    name = getattr(module_of(main), "ARGUMENTS", None)
    if name is None:
        raise InputError(f"{words[0]}: unexpected argument: expected --flags")
    if flags.FLAGS[name].present:
        raise InputError(f"{words[0]}: unexpected argument beside --{name}")
    setattr(flags.FLAGS, name, words)


def own_flags() -> list[flags.Flag]:
    """The flags of the command that runs."""
    return [
        flag
        for module, some in flags.FLAGS.flags_by_module_dict().items()
        if module == sys.argv[0] or module.startswith(OURS)
        for flag in some
    ]


def module_of(main: Callable) -> ModuleType:
    """The module of a command's main."""
    return sys.modules[main.__module__]


def asked_for(argv: list[str], main: Callable) -> str | None:
    """Returns the help that the arguments ask for; None: they ask for none."""
    given = argv[1 : argv.index("--")] if "--" in argv else argv[1:]
    for word in given:
        if word in (*SHORT, *FULL):
            return help_text(module_of(main), full=word in FULL)
    return None


def help_text(module: ModuleType, *, full: bool) -> str:
    """The text of a command's `--help` or, in full, `--helpfull`.

    Args:
      module: its docstring is the text, `USUAL` the names of its usual flags (all where
        it has none).
      full: with all other flags, by subject.
    """
    every = {flag.name: flag for flag in own_flags()}
    usual = getattr(module, "USUAL", tuple(every))
    parts = [inspect.cleandoc(module.__doc__ or "")]
    parts.append(_listed("usual flags", [every[name] for name in usual]))
    rest = [flag for name, flag in every.items() if name not in usual]
    if full:
        headings = [HEADINGS.get(flag.name, "Other flags") for flag in rest]
        for heading in dict.fromkeys(headings):
            some = [x for x, h in zip(rest, headings, strict=True) if h == heading]
            parts.append(_listed(heading, some))
    hidden = 0 if full else len(rest)
    more = f"--helpfull shows {hidden} more. " if hidden else ""
    return "\n\n".join([*parts, more + FROM_FILE])


def example(module: ModuleType) -> str:
    """The first command of a docstring, "" without one."""
    text = re.sub(r"\\\n\s*", "", module.__doc__ or "")
    found = re.search(r"^ {4}(\S.*?)(?: {2,}.*)?$", text, re.M)
    return found[1] if found else ""


def _listed(heading: str, some: Iterable[flags.Flag]) -> str:
    return "\n".join([f"{heading}:", *map(_line, some)])


def _line(flag: flags.Flag) -> str:
    """A flag, what it is and its default, in as few lines as it takes."""
    name = f"  --{'[no]' if flag.boolean else ''}{flag.name}"
    said = re.sub(r"^<.*?>: ", "", str(flag.help))  # absl's list of an enum's values
    said = said.partition(";\n")[0]  # absl's words on flags that may be repeated
    default = ""
    if said.endswith(AS_SAID):
        # of a command with recipes; the others start without loading them
        from rcirl_jax.cli.flags import recipes_default

        said, default = said.removesuffix(AS_SAID), recipes_default(flag.name)
    if values := getattr(flag.parser, "enum_values", None):
        said += f": {', '.join(values)}"
    if flag.default not in (None, "", []) and flag.default is not False:
        shown = str(flag.default_as_str)[1:-1]
        shown = shown if len(shown) <= LONGEST else f"{shown[:LONGEST]}..."
        default = f" (default: {shown})"
    lines = textwrap.wrap(
        said + default,
        WIDTH,
        initial_indent=f"{name}  ".ljust(INDENT),
        subsequent_indent=" " * INDENT,
        break_on_hyphens=False,
    )
    return "\n".join(lines)


def provenance(weights: Sequence[str] = ()) -> dict:
    """Flags of the command, git commit, versions and machine.

    Starts JAX's devices, as `rcirl_jax.runtime.provenance.provenance`.

    Args:
      weights: weights files that were read; their hashes name them.

    Raises:
      InputError: a weights file is missing or damaged.
    """
    read = {str(path): load_weights(path).sha256 for path in weights}
    return {
        "flags": {flag.name: flag.value for flag in own_flags()},
        **made_by.provenance(),
        **({"weights_sha256": read} if read else {}),
    }


def made_by_file(**more: object) -> Callable[[Dataset], None]:
    """Returns what writes made_by.json of a dataset: hash, provenance, `more`."""

    def write(dataset: Dataset) -> None:
        facts = {"data_hash": dataset.hash, **more}
        dataset.write_facts({**facts, "made_by": provenance()})

    return write
