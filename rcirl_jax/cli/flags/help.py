"""The help of a command: what it does, its usual flags, then all others by subject."""

import functools
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Iterable
from types import ModuleType

from absl import flags

OURS = ("rcirl_jax.cli.", "experiments.")  # modules whose flags are a command's
SHARED = "rcirl_jax.cli.flags."  # of them, those of a subject each
SHORT, FULL = (
    ("-h", "-?", "-help", "--help", "--helpshort"),
    ("-helpfull", "--helpfull"),
)
WIDTH, INDENT = 100, 20  # columns
LONGEST = 40  # characters of a default
AS_SAID = " (default: the recipe's)"  # of a flag beside a recipe; help shows its value
FROM_FILE = "--flagfile=FILE reads flags from a file, one a line."


def own_flags() -> dict[str, list[flags.Flag]]:
    """The flags of the command that runs, by the module that defines them.

    Second names (`also_named`) are left out.
    """
    found = {
        module: [flag for flag in some if not second_name(flag)]
        for module, some in flags.FLAGS.flags_by_module_dict().items()
        if module == sys.argv[0] or module.startswith(OURS)
    }
    return {module: some for module, some in found.items() if some}


def also_named(old: str, name: str) -> None:
    """Let a flag be given by an old name too, which help does not show."""
    flags.DEFINE_alias(old, name)


def second_name(flag: flags.Flag) -> bool:
    """Whether a flag is another's second name."""
    return str(flag.help).startswith("Alias for --")


def asked_for(argv: list[str], main: Callable) -> str | None:
    """The help that the arguments ask for; None: they ask for none."""
    given = argv[1 : argv.index("--")] if "--" in argv else argv[1:]
    for word in given:
        if word in (*SHORT, *FULL):
            return help_text(module_of(main), full=word in FULL)
    return None


def module_of(main: Callable) -> ModuleType:
    """The module of a command's main."""
    return sys.modules[main.__module__]


def help_text(module: ModuleType, *, full: bool) -> str:
    """What `--help` or, in full, `--helpfull` says of a command.

    Args:
      module: its docstring is the text, `USUAL` the names of its usual flags (all where
        it has none).
      full: with all other flags, by the module that defines them.
    """
    own = own_flags()
    every = {flag.name: flag for some in own.values() for flag in some}
    usual = getattr(module, "USUAL", tuple(every))
    rest = {
        name: [flag for flag in some if flag.name not in usual]
        for name, some in own.items()
    }
    parts = [inspect.cleandoc(module.__doc__ or "")]
    parts.append(_listed("usual flags", [every[name] for name in usual]))
    if full:
        parts += [_listed(_subject(name), some) for name, some in rest.items() if some]
    hidden = 0 if full else len(every) - len(usual)
    parts.append(
        f"--helpfull shows {hidden} more. {FROM_FILE}" if hidden else FROM_FILE
    )
    return "\n\n".join(parts)


def example(module: ModuleType) -> str:
    """The first command of a docstring, "" without one."""
    text = re.sub(r"\\\n\s*", "", module.__doc__ or "")
    found = re.search(r"^ {4}(\S.*?)(?: {2,}.*)?$", text, re.M)
    return found[1] if found else ""


def _subject(name: str) -> str:
    """What the flags of a module are about: the first line of its docstring."""
    if not name.startswith(SHARED):
        return "Other flags"
    return str(sys.modules[name].__doc__).splitlines()[0].rstrip(".")


def _listed(heading: str, some: Iterable[flags.Flag]) -> str:
    return "\n".join([f"{heading}:", *map(_line, some)])


@functools.cache
def _of_recipe(name: str) -> str:
    """What the default recipe says where a flag is not given."""
    from rcirl_jax.cli.flags.recipe import DEFAULT, load_recipe, said_by

    value = said_by(load_recipe(DEFAULT))[name]
    if isinstance(value, bool):
        value = str(value).lower()
    if isinstance(value, tuple):
        value = ",".join(map(str, value))
    return f" (default: {value}, of the recipe)" if value != "" else ""


def _line(flag: flags.Flag) -> str:
    """A flag, what it is and its default, in as few lines as it takes."""
    name = f"  --{'[no]' if flag.boolean else ''}{flag.name}"
    said = re.sub(r"^<.*?>: ", "", str(flag.help))  # absl's list of an enum's values
    default = _of_recipe(flag.name) if said.endswith(AS_SAID) else ""
    said = said.removesuffix(AS_SAID)
    if values := getattr(flag.parser, "enum_values", None):
        said += f": {', '.join(values)}"
    if flag.default not in (None, "", []) and flag.default is not False:
        shown = str(flag.default_as_str)[1:-1]
        shown = shown if len(shown) <= LONGEST else f"{shown[:LONGEST]}..."
        default = f" (default: {shown})"
    begin, rest = f"{name}  ".ljust(INDENT), " " * INDENT
    lines = textwrap.wrap(
        said + default,
        WIDTH,
        initial_indent=begin,
        subsequent_indent=rest,
        break_on_hyphens=False,
    )
    return "\n".join(lines)
