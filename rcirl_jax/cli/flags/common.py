"""What the commands share: running, reading flags, provenance."""

import contextlib
import functools
import os
import re
import select
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NoReturn, TextIO

import jax
from absl import app, flags, logging

from rcirl_jax.cli.flags.help import asked_for, example, module_of, own_flags
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError, did_you_mean, extra_of
from rcirl_jax.export.reader import load_weights
from rcirl_jax.runtime import provenance as made_by
from rcirl_jax.runtime import signals as interrupts
from rcirl_jax.runtime.atomic_files import is_text

EXIT_BAD_INPUT = 2
EXIT_FAULT = 70  # of this program, as sysexits.h has it
NO_MEMORY = "RESOURCE_EXHAUSTED"  # how JAX's errors begin that come of its want


def run(main: Callable[[], None]) -> None:
    """Run a main; bad input becomes one line on stderr and exit status 2.

    So do a place that cannot be written and memory that is not given. A fault of the
    program is one line too, with status 70, and its traceback a file to report. SIGTERM
    ends with 143, SIGINT with 130, within ten seconds (`rcirl_jax.runtime.signals`).
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

    logging.set_verbosity(logging.WARNING)

    def guarded(argv: list[str]) -> None:
        try:
            _take(argv[1:], main)
            main()
        except InputError as error:
            _refuse(error)
        except BrokenPipeError:
            raise
        except OSError as error:
            _refuse(_about(error))
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            why = " ".join(str(error).split())[:200]
            if not isinstance(error, MemoryError) and not why.startswith(NO_MEMORY):
                _refuse(_fault(error), EXIT_FAULT)
            _refuse(f"memory: {why or 'refused'}: expected more for this work")
        except interrupts.Interrupted as stop:
            _leave(stop.number)
        except Exception as error:
            if known := extra_of(error):
                _refuse(known)
            _refuse(_fault(error), EXIT_FAULT)

    interrupts.install()
    with _while_read():
        app.run(guarded, flags_parser=functools.partial(_parse, main))


@contextlib.contextmanager
def _while_read() -> Iterator[None]:
    """End without a word where nobody reads the output any more, as behind `| head`."""
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
    """Write what is left of the output; an OSError unless an error was said before."""
    try:
        output.flush()
    except BrokenPipeError:
        raise
    except OSError:  # no room
        _drop(output)
        if not status:
            raise


def _unread(stream: TextIO) -> bool:
    """Whether it is a pipe or socket whose other end is closed."""
    poll = select.poll()
    try:
        poll.register(stream.fileno(), 0)  # errors are told without asking
    except (OSError, ValueError):  # it is no file
        return False
    return bool(poll.poll(0))


def _drop(stream: TextIO) -> None:
    """Let what the stream still holds go nowhere when Python ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _take(words: list[str], main: Callable) -> None:
    """Arguments without a name: of the flag that a command calls `ARGUMENTS`."""
    if not words:
        return
    name = getattr(module_of(main), "ARGUMENTS", None)
    if name is None:
        raise InputError(f"{words[0]}: unexpected argument: expected --flags")
    if flags.FLAGS[name].present:
        raise InputError(f"{words[0]}: unexpected argument beside --{name}")
    setattr(flags.FLAGS, name, words)


def _refuse(what: object, status: int = EXIT_BAD_INPUT) -> NoReturn:
    """One line on stderr, and the exit status."""
    print(f"error: {what}", file=sys.stderr)
    sys.exit(status)


def _about(error: OSError) -> str:
    """One line: the file, if the system told it, and the reason."""
    known = error.filename is not None and error.strerror is not None
    text = f"{error.filename}: {error.strerror}" if known else str(error)
    return " ".join(text.split())


def _fault(error: Exception) -> str:
    """One line on an error that nothing foresaw; its traceback goes to a file."""
    lines = traceback.format_exception(error)
    with tempfile.NamedTemporaryFile(
        "w", prefix="rcirl-jax-fault-", suffix=".txt", delete=False
    ) as file:
        file.write(" ".join(sys.argv) + "\n" + "".join(lines))
    place = traceback.extract_tb(error.__traceback__)[-1]
    why = " ".join(str(error).split())[:200]
    return (
        f"{type(error).__name__}: {why} ({Path(place.filename).name}:{place.lineno}): "
        "a fault of rcirl-jax, not of your input; please report it as CONTRIBUTING.md "
        f"says, with the file {file.name}"
    )


def _leave(number: int) -> None:
    """End by a signal; one of several processes says goodbye to the others first."""
    if jax.distributed.is_initialized():
        sys.exit(128 + number)
    interrupts.leave(number)


def _parse(main: Callable, argv: list[str]) -> list[str]:
    """Absl's parser, with our help, and its complaints as one line.

    Names of files that are no UTF-8 could not be written into what is made of them.
    """
    odd = [text for text in argv if not is_text(text)]
    if odd:
        _refuse(f"{odd[0]!a}: expected UTF-8")
    if text := asked_for(argv, main):
        print(text)
        sys.exit(0)
    try:
        return flags.FLAGS(argv)
    except flags.Error as error:
        said = str(error)
        _refuse(_missing(said, main) or _unfit(said) or " ".join(said.split()))


def _missing(complaint: str, main: Callable) -> str:
    """One line on required flags that were not given; "" if it is about others."""
    names = re.findall(r"^flag --(\w+)=None: ", complaint, re.M)
    if not names:
        return ""
    wanted = "; ".join(str(flags.FLAGS[name].help) for name in names)
    shown = example(module_of(main))
    given = f"{', '.join(f'--{name}' for name in names)}: not given: expected {wanted}"
    return f"{given}; for example: {shown}" if shown else given


def _unfit(complaint: str) -> str:
    """One line on a value that a flag cannot have; "" if it is about others."""
    unread = "value should|invalid literal|could not convert|.* is not a"
    found = re.match(rf"flag --(\w+)=(.*?): ({unread})", complaint)
    if not found:
        return ""
    name, value, _ = found.groups()
    parser = flags.FLAGS[name].parser
    if known := getattr(parser, "enum_values", ()):
        return f"--{name}: {value}: expected one of {', '.join(known)}" + did_you_mean(
            value, known
        )
    return f"--{name}: {value}: expected {parser.syntactic_help}"


def alone(flag: str, *others: str) -> None:
    """Refuse flags that were given beside one that leaves them unread."""
    for other in others:
        found = flags.FLAGS[other]
        if found.present:
            raise InputError(f"--{other}: {found.value}: expected none beside --{flag}")


def unread(*names: str) -> None:
    """Flags of other files that a command does not read: unknown to it, unrecorded."""
    for name in names:
        delattr(flags.FLAGS, name)


def floats(values: list[str], flag: str) -> tuple[float, ...]:
    """A comma list of numbers, with the flag's name on error."""
    try:
        return tuple(float(value) for value in values)
    except ValueError as error:
        raise InputError(f"--{flag}: {values}: expected numbers") from error


def hidden_sizes(values: list[str], flag: str = "hidden_size") -> tuple[int, ...]:
    """Units per layer: "15", "32,16", or "0" for the linear reward."""
    try:
        sizes = tuple(int(value) for value in values)
    except ValueError as error:
        raise InputError(f"--{flag}: {values}: expected integers") from error
    if sizes == (0,) or not sizes:
        return ()
    if any(not 1 <= size <= 4096 for size in sizes):
        raise InputError(f"--{flag}: {values}: expected 1 to 4096, or 0 alone")
    return sizes


def provenance(weights: Sequence[str] = ()) -> dict:
    """Flags of the command, git commit, versions and machine.

    Starts JAX's devices, as `rcirl_jax.runtime.provenance.provenance`.

    Args:
      weights: weights files that were read; their hashes name them.

    Raises:
      InputError: a weights file is missing or damaged.
    """
    own = [flag for some in own_flags().values() for flag in some]
    read = {str(path): load_weights(path).sha256 for path in weights}
    return {
        "flags": {flag.name: flag.value for flag in own},
        **made_by.provenance(),
        **({"weights_sha256": read} if read else {}),
    }


def made_by_file(
    more: Mapping[str, object] | None = None,
) -> Callable[[Dataset], None]:
    """What writes a new dataset's made_by.json: its hash, provenance and `more`.

    Args:
      more: further facts.
    """

    def write(dataset: Dataset) -> None:
        facts = {"data_hash": dataset.hash, **(more or {})}
        dataset.write_facts({**facts, "made_by": provenance()})

    return write
