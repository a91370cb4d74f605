"""Scenario families: data_specs/scenarios/*.toml -> validated `Family` objects.

The format is described in docs/scenarios.md. Unknown keys are errors, so that
a misspelt one does not silently keep its default.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.simulation.cases import NUM_MOVES, NUM_PHASES
from rcirl_jax.simulation.catalogue.expressions import Expression

DISTRIBUTIONS = {"uniform": 2, "normal": 2, "lognormal": 2, "choice": None}
KINDS = ("vehicle", "cyclist", "pedestrian", "static")
MODELS = ("lane", "oncoming", "crossing")
LINE_KINDS = ("light", "stop_sign")
LARGEST = 1e9  # of a parameter's numbers
TOP = {
    "family",
    "title",
    "source",
    "cases",
    "parameters",
    "derived",
    "road",
    "curve",
    "limit",
    "shift",
    "line",
    "agent",
    "perception",
    "compound",
}
ROAD = {
    "speed_limit": None,
    "ego_speed": None,
    "lane_width": 3.5,
    "lanes_left": 0,
    "lanes_right": 0,
    "oncoming": 0,
    "shoulder": 0.5,
    "first": None,
    "spacing": None,
    "events": None,
    "destination": 1e6,
}
# element -> field -> default (None: required)
ELEMENTS: dict[str, dict[str, float | str | None]] = {
    "curve": {"at": None, "length": None, "kappa": None, "ramp": 20.0},
    "limit": {"at": None, "speed": None},
    "shift": {"at": None, "length": None, "l": None},
    "line": {"at": None, "green": 20.0, "yellow": 3.0, "red": 20.0, "offset": 0.0},
}
DRIVER = (
    "desired",
    "headway",
    "standstill",
    "acceleration",
    "braking",
    "delay",
    "politeness",
    "threshold",
    "lapse_start",
    "lapse_end",
)
FLAGS = {
    "relative": False,
    "reacts": True,
    "obeys_lines": True,
    "changes_lane": False,
}
AGENT = {
    "count": 1.0,
    "appear_s": "start",
    "appear_t": 0.0,
    "s": None,
    "l": 0.0,
    "heading": 0.0,
    "v": 0.0,
    "v_share": 0.0,
    "arrival_s": "inf",
}
PERCEPTION = ("sigma_position", "sigma_speed", "latency", "dropout")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter:
    """One drawn quantity."""

    name: str
    distribution: str  # key of DISTRIBUTIONS
    arguments: tuple[float, ...]
    clip: tuple[float, float] | None
    per_case: bool  # drawn once per case, not per event
    unit: str
    meaning: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Element:
    """A curve, limit, shift or line: expressions by field."""

    kind: str  # for a line "light" or "stop_sign", else ""
    when: Expression | None
    fields: Mapping[str, Expression]


@dataclasses.dataclass(frozen=True, kw_only=True)
class AgentSpec:
    """One [[agent]]: expressions by field."""

    kind: str  # one of KINDS
    model: str  # one of MODELS
    when: Expression | None
    flags: Mapping[str, bool]
    fields: Mapping[str, Expression]
    phases: tuple[tuple[Expression, ...], ...]  # (start, speed, rate)
    moves: tuple[tuple[Expression, ...], ...]  # (start, l, speed)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Family:
    """One family file, checked."""

    name: str
    title: str
    source: str
    cases: int
    path: str
    parameters: tuple[Parameter, ...]
    derived: Mapping[str, Expression]
    road: Mapping[str, Expression]
    elements: Mapping[str, tuple[Element, ...]]  # by key of ELEMENTS
    agents: tuple[AgentSpec, ...]
    perception: Mapping[str, Expression]
    compound: tuple[str, ...]


def family_names() -> tuple[str, ...]:
    """All families of data_specs/scenarios, in alphabetical order."""
    return tuple(sorted(p.stem for p in (spec_root() / "scenarios").glob("*.toml")))


@functools.lru_cache(maxsize=256)
def load_family(name_or_path: str) -> Family:
    """A family by its name, or by the path of a TOML file.

    Raises:
      InputError: no such family, or one line that names file, field and value.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = spec_root() / "scenarios" / f"{name_or_path}.toml"
    if not path.is_file():
        raise InputError(
            f"--suite: {name_or_path}: expected one of {', '.join(family_names())}"
        )
    spec = load_toml(path)
    with as_input_error(str(path), "a family of scenarios"):
        return _read(path, spec)


def _read(path: Path, spec: dict[str, Any]) -> Family:
    _known(path, "", spec, TOP)
    for key in ("family", "title", "source"):
        if not isinstance(spec.get(key), str) or not spec[key]:
            raise InputError(f"{path}: {key}: {spec.get(key)!r}: expected a text")
    if spec["family"] != path.stem:
        raise InputError(
            f"{path}: family: {spec['family']}: expected the file's name, {path.stem}"
        )
    cases = spec.get("cases")
    if not isinstance(cases, int) or isinstance(cases, bool) or cases < 1:
        raise InputError(f"{path}: cases: {cases!r}: expected a whole number >= 1")
    compound = spec.get("compound", [])
    if not isinstance(compound, list) or not all(isinstance(x, str) for x in compound):
        raise InputError(f"{path}: compound: {compound!r}: expected family names")
    own = [key for key in (*ELEMENTS, "agent") if key in spec]
    if compound and own:
        raise InputError(f"{path}: compound: with {own[0]}: expected either, not both")
    return Family(
        name=spec["family"],
        title=spec["title"],
        source=spec["source"],
        cases=cases,
        path=str(path),
        parameters=tuple(
            _parameter(path, name, row)
            for name, row in _table(path, spec, "parameters").items()
        ),
        derived={
            name: Expression(text, f"{path}: derived.{name}")
            for name, text in _table(path, spec, "derived").items()
        },
        road=_fields(path, "road", _table(path, spec, "road"), ROAD),
        elements={
            key: tuple(_element(path, key, row) for row in _rows(path, spec, key))
            for key in ELEMENTS
        },
        agents=tuple(_agent(path, row) for row in _rows(path, spec, "agent")),
        perception=_fields(
            path,
            "perception",
            _table(path, spec, "perception"),
            dict.fromkeys(PERCEPTION, 0.0),
        ),
        compound=tuple(compound),
    )


def _table(path: Path, spec: dict, key: str) -> dict:
    found = spec.get(key, {})
    if not isinstance(found, dict):
        raise InputError(f"{path}: {key}: expected a table")
    return found


def _rows(path: Path, spec: dict, key: str) -> list[dict]:
    found = spec.get(key, [])
    if not isinstance(found, list) or not all(isinstance(x, dict) for x in found):
        raise InputError(f"{path}: {key}: expected [[{key}]] tables")
    return found


def _known(path: Path, where: str, row: Mapping, allowed: set[str]) -> None:
    for key in row:
        if key not in allowed:
            raise InputError(
                f"{path}: {where}{key}: unknown: expected {', '.join(sorted(allowed))}"
            )


def _is_numbers(value: object, largest: float = LARGEST) -> bool:
    return isinstance(value, list) and all(
        isinstance(x, int | float)
        and not isinstance(x, bool)
        and -largest <= x <= largest
        for x in value
    )


def _parameter(path: Path, name: str, row: Any) -> Parameter:  # noqa: ANN401
    where = f"{path}: parameters.{name}"
    if not isinstance(row, dict) or not name.isidentifier():
        raise InputError(f"{where}: expected a name and a table")
    _known(
        path,
        f"parameters.{name}.",
        row,
        {*DISTRIBUTIONS, "clip", "per", "unit", "meaning"},
    )
    chosen = [key for key in DISTRIBUTIONS if key in row]
    if len(chosen) != 1:
        raise InputError(f"{where}: {chosen}: expected one of {list(DISTRIBUTIONS)}")
    arguments, count = row[chosen[0]], DISTRIBUTIONS[chosen[0]]
    numbers = _is_numbers(arguments) and arguments
    if not numbers or (count and len(arguments) != count):
        raise InputError(f"{where}: {chosen[0]}: {arguments}: expected numbers")
    if row.get("per", "event") not in ("case", "event"):
        raise InputError(f"{where}: per: {row['per']}: expected case or event")
    for key in ("unit", "meaning"):
        if not isinstance(row.get(key), str):
            raise InputError(f"{where}: {key}: missing: expected a text")
    clip = row.get("clip")
    if clip is not None and (
        not _is_numbers(clip, math.inf) or len(clip) != 2 or clip[0] > clip[1]
    ):
        raise InputError(f"{where}: clip: {clip}: expected [low, high]")
    return Parameter(
        name=name,
        distribution=chosen[0],
        arguments=tuple(float(x) for x in arguments),
        clip=None if clip is None else (float(clip[0]), float(clip[1])),
        per_case=row.get("per") == "case",
        unit=row["unit"],
        meaning=row["meaning"],
    )


def _fields(
    path: Path, where: str, row: Mapping, defaults: Mapping[str, float | str | None]
) -> dict[str, Expression]:
    """Expressions of all fields, defaults filled in."""
    _known(path, f"{where}.", row, set(defaults))
    made = {}
    for key, default in defaults.items():
        value = row.get(key, default)
        if value is None:
            raise InputError(f"{path}: {where}.{key}: missing: expected an expression")
        made[key] = _expression(path, f"{where}.{key}", value)
    return made


def _expression(path: Path, where: str, value: Any) -> Expression:  # noqa: ANN401
    if not isinstance(value, str | int | float):
        raise InputError(f"{path}: {where}: {value!r}: expected an expression")
    return Expression(value, f"{path}: {where}")


def _when(path: Path, where: str, row: dict) -> Expression | None:
    if "when" not in row:
        return None
    return _expression(path, f"{where}.when", row["when"])


def _one_of(path: Path, where: str, found: Any, known: tuple) -> str:  # noqa: ANN401
    if found not in known:
        raise InputError(f"{path}: {where}: {found!r}: expected {', '.join(known)}")
    return found


def _element(path: Path, key: str, row: dict) -> Element:
    kind = ""
    rest = {name: value for name, value in row.items() if name != "when"}
    if key == "line":
        kind = _one_of(path, "line.kind", rest.pop("kind", None), LINE_KINDS)
    return Element(
        kind=kind,
        when=_when(path, key, row),
        fields=_fields(path, key, rest, ELEMENTS[key]),
    )


def _agent(path: Path, row: dict) -> AgentSpec:
    special = {"kind", "model", "when", "phases", "moves", *FLAGS}
    rest = {name: value for name, value in row.items() if name not in special}
    optional = {
        key: rest.pop(key) for key in (*DRIVER, "length", "width") if key in rest
    }
    fields = _fields(path, "agent", rest, AGENT)
    for key, value in optional.items():
        fields[key] = _expression(path, f"agent.{key}", value)
    for key in FLAGS:
        if not isinstance(row.get(key, False), bool):
            raise InputError(
                f"{path}: agent.{key}: {row[key]!r}: expected true or false"
            )
    return AgentSpec(
        kind=_one_of(path, "agent.kind", row.get("kind"), KINDS),
        model=_one_of(path, "agent.model", row.get("model", "lane"), MODELS),
        when=_when(path, "agent", row),
        flags={key: row.get(key, default) for key, default in FLAGS.items()},
        fields=fields,
        phases=_triples(path, "agent.phases", row.get("phases", []), NUM_PHASES),
        moves=_triples(path, "agent.moves", row.get("moves", []), NUM_MOVES),
    )


def _triples(
    path: Path,
    where: str,
    rows: Any,  # noqa: ANN401
    most: int,
) -> tuple[tuple[Expression, ...], ...]:
    if not isinstance(rows, list) or len(rows) > most:
        raise InputError(f"{path}: {where}: expected at most {most} triples")
    for row in rows:
        if not isinstance(row, list) or len(row) != 3:
            raise InputError(f"{path}: {where}: {row!r}: expected three expressions")
    return tuple(
        tuple(_expression(path, where, value) for value in row) for row in rows
    )
