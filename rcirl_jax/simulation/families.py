"""Scenario families: data_specs/scenarios/*.toml -> validated `Family` objects.

The format is described in docs/scenarios.md. Unknown keys are errors, so that
a misspelt one does not silently keep its default.
"""

import ast
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.runtime.checked import checked
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.simulation.cases import (
    DRIVER,
    FLAGS,
    NUM_MOVES,
    NUM_PHASES,
    NUM_ROAD,
    ROAD_STEP_M,
    Road,
    node,
)

STATIONS = np.arange(NUM_ROAD) * ROAD_STEP_M  # m, the road grid


@dataclasses.dataclass
class Parts:
    """The elements of all events of a case, joined."""

    kappa: np.ndarray
    limits: list[tuple[float, float]]
    shifts: list[tuple[float, float, float]]
    routes: list[tuple[float, ...]]  # m, m, first and last lane
    lines: list[dict[str, float]]
    agents: list[dict]


def road_of(road: dict[str, float], parts: Parts) -> Road:
    """The road grid: curvature, limits and the given path along it."""
    limit = np.full(NUM_ROAD, road["speed_limit"])
    for at, speed in sorted(parts.limits):
        limit[at <= STATIONS] = speed
    path = np.zeros(NUM_ROAD)
    for at, length, target in sorted(parts.shifts):
        begin = float(np.interp(at, STATIONS, path))
        u = np.clip((STATIONS - at) / max(length, ROAD_STEP_M), 0.0, 1.0)
        smooth = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        path = np.where(at <= STATIONS, begin + (target - begin) * smooth, path)
    width = road["lane_width"]
    f = np.float32
    return node(
        Road,
        kappa=parts.kappa.astype(f),
        speed_limit=limit.astype(f),
        path_l=path.astype(f),
        lane_width=f(width),
        lanes_left=np.int32(road["lanes_left"]),
        lanes_right=np.int32(road["lanes_right"]),
        edge_left=f(
            (road["lanes_left"] + road["oncoming"] + 0.5) * width + road["shoulder"]
        ),
        edge_right=f(-((road["lanes_right"] + 0.5) * width + road["shoulder"])),
        **_route(road, path, parts.routes),
        destination=f(road["destination"]),
    )


ON_LANE = (
    0.02  # 1, of a lane's width: nearer to its middle a path is on that lane alone
)


def _route(
    road: dict[str, float], path: np.ndarray, routes: list[tuple[float, ...]]
) -> dict[str, np.ndarray]:
    """Edges [R] m of the lanes that the route leaves free, fields of `Road`.

    Free are the lanes that the given path is on, both while it goes from one to the
    other, and those that a [[route]] opens. The outermost come with their shoulder.

    Args:
      road: its numbers.
      path: [R] m, offset of the given path.
      routes: station, length, first and last lane of each opening.
    """
    width, shoulder = road["lane_width"], road["shoulder"]
    ends = -road["lanes_right"], road["lanes_left"] + road["oncoming"]
    low = np.floor(path / width + ON_LANE)
    high = np.ceil(path / width - ON_LANE)
    for at, length, first, last in routes:
        inside = (at <= STATIONS) & (at + length >= STATIONS)
        low = np.where(inside, np.minimum(low, first), low)
        high = np.where(inside, np.maximum(high, last), high)
    low, high = np.clip(low, *ends), np.clip(high, *ends)
    right = (low - 0.5) * width - shoulder * (low <= ends[0])
    left = (high + 0.5) * width + shoulder * (high >= ends[1])
    edges = {"route_left": left, "route_right": right}
    return {name: edge.astype(np.float32) for name, edge in edges.items()}


MAX_LENGTH = 400  # characters of an expression
MAX_EXPONENT = 64.0  # largest |exponent| of a power

CONSTANTS = {"pi": math.pi, "inf": math.inf, "true": 1.0, "false": 0.0}


def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def _where(condition: float, yes: float, no: float) -> float:
    return yes if condition else no


def _power(base: float, exponent: float) -> float:
    if abs(exponent) > MAX_EXPONENT:
        raise ValueError(f"exponent {exponent:g}: expected at most {MAX_EXPONENT:g}")
    return float(base) ** exponent


# names that an expression can call
FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(math, name) for name in ("sqrt", "sin", "cos", "tan", "atan")},
    **{"exp": math.exp, "log": math.log, "floor": math.floor, "round": round},
    **{"min": min, "max": max, "abs": abs, "clip": _clip, "where": _where},
}

_SYNTAX = "Expression BinOp UnaryOp BoolOp Compare Call Name Load Constant"
_SYNTAX += " Add Sub Mult Div FloorDiv Mod Pow UAdd USub Not And Or Lt LtE Gt GtE Eq"
_ALLOWED = tuple(getattr(ast, name) for name in (*_SYNTAX.split(), "NotEq"))


class _Bound(ast.NodeTransformer):
    """Powers become calls of the bounded power."""

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        """Replace `a ** b`."""
        self.generic_visit(node)
        if not isinstance(node.op, ast.Pow):
            return node
        name = ast.Name(id="_power", ctx=ast.Load())
        return ast.Call(func=name, args=[node.left, node.right], keywords=[])


def _number_text(number: float) -> str:
    try:
        return repr(float(number)) if math.isfinite(number) else "inf"
    except OverflowError:
        return "inf"


class Expression:
    """One checked expression; calling it with variables gives a float."""

    def __init__(self, text: str | float | bool, where: str) -> None:
        """Check and compile.

        Args:
          text: the expression, or a plain number.
          where: "FILE: field", for messages.

        Raises:
          InputError: not arithmetic, or something that is not allowed.
        """
        self.text, self.where = str(text), where
        if isinstance(text, bool | int | float):
            self.text = _number_text(text)
        if len(self.text) > MAX_LENGTH:
            raise InputError(f"{where}: {len(self.text)} characters: too long")
        try:
            tree = ast.parse(self.text.strip(), mode="eval")
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise InputError(f"{where}: {self.text!r}: not arithmetic") from error
        self.names = frozenset(self._check(tree))
        bounded = ast.fix_missing_locations(_Bound().visit(tree))
        self._code = compile(bounded, "<expression>", "eval")

    def _check(self, tree: ast.Expression) -> list[str]:
        names: list[str] = []
        called = {
            id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)
        }
        for part in ast.walk(tree):
            if not isinstance(part, _ALLOWED):
                raise self._refuse(type(part).__name__)
            if isinstance(part, ast.Constant) and not isinstance(
                part.value, int | float
            ):
                raise self._refuse(f"constant {part.value!r}")
            if isinstance(part, ast.Call):
                self._check_call(part)
            elif isinstance(part, ast.Name) and id(part) not in called:
                names.append(part.id)
        return names

    def _check_call(self, node: ast.Call) -> None:
        name = node.func.id if isinstance(node.func, ast.Name) else "?"
        if name not in FUNCTIONS or node.keywords:
            raise self._refuse(f"call of {name}")

    def _refuse(self, what: str) -> InputError:
        return InputError(
            f"{self.where}: {self.text!r}: {what}: expected arithmetic with "
            f"{', '.join(FUNCTIONS)}"
        )

    def __call__(self, variables: Mapping[str, float]) -> float:
        """The value under the variables.

        Raises:
          InputError: an unknown name, or no finite-or-infinite real number.
        """
        try:
            value = float(eval(self._code, _GLOBALS, {**CONSTANTS, **variables}))
        except NameError as error:
            raise InputError(
                f"{self.where}: {self.text!r}: {error}: expected a parameter or a "
                "derived value"
            ) from error
        except (ArithmeticError, ValueError, TypeError) as error:
            raise InputError(f"{self.where}: {self.text!r}: {error}") from error
        if math.isnan(value):
            raise InputError(f"{self.where}: {self.text!r}: not a number")
        return value


# names an expression can reach: our functions and nothing built in
_GLOBALS = {"__builtins__": {}, "_power": _power, **FUNCTIONS}


DISTRIBUTIONS = ("uniform", "normal", "lognormal", "choice")
KINDS = ("vehicle", "cyclist", "pedestrian", "static")
MODELS = ("lane", "oncoming", "crossing")
LINE_KINDS = ("light", "stop_sign")
LARGEST = 1e9  # of a parameter's numbers
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
    "route": {"at": None, "length": "inf", "low": None, "high": None},
    "line": {"at": None, "green": 20.0, "yellow": 3.0, "red": 20.0, "offset": 0.0},
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

Text = Annotated[str, msgspec.Meta(min_length=1)]
Number = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
Pair = Annotated[list[Number], msgspec.Meta(min_length=2, max_length=2)]
Formula = str | bool | int | float
Triple = tuple[Formula, Formula, Formula]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """A family as it is written; tables of expressions are checked one by one."""

    family: Text
    title: Text
    source: Text
    cases: Annotated[int, msgspec.Meta(ge=1)]
    parameters: dict[str, Any] = {}
    derived: dict[str, Any] = {}
    road: dict[str, Any] = {}
    curve: list[dict] = []
    limit: list[dict] = []
    shift: list[dict] = []
    route: list[dict] = []
    line: list[dict] = []
    agent: list[dict] = []
    perception: dict[str, Any] = {}
    compound: list[str] = []


class _Drawn(msgspec.Struct, forbid_unknown_fields=True):
    """[parameters.NAME] as it is written: one of `DISTRIBUTIONS`."""

    unit: str
    meaning: str
    uniform: Pair | None = None
    normal: Pair | None = None
    lognormal: Pair | None = None
    choice: Annotated[list[Number], msgspec.Meta(min_length=1)] | None = None
    clip: tuple[float, float] | None = None
    per: str = "event"


class _Agent(msgspec.Struct):
    """The keys of an [[agent]] that are no expressions of `AGENT` or `DRIVER`."""

    kind: str
    model: str = "lane"
    relative: bool = False
    reacts: bool = True
    obeys_lines: bool = True
    changes_lane: bool = False
    # (start, speed, rate), (start, l, speed)
    phases: Annotated[list[Triple], msgspec.Meta(max_length=NUM_PHASES)] = []
    moves: Annotated[list[Triple], msgspec.Meta(max_length=NUM_MOVES)] = []


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
    """A curve, limit, shift, route or line: expressions by field."""

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


def family_title(name: str) -> str:
    """Returns a family's title; the name itself where it is none of ours."""
    return load_family(name).title if name in family_names() else name


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
            f"suite: {name_or_path}: expected one of {', '.join(family_names())}"
        )
    spec = load_toml(path)
    with as_input_error(str(path), "a family of scenarios"):
        return _read(path, spec)


def _read(path: Path, spec: dict[str, Any]) -> Family:
    found = checked(spec, _File, path)
    if found.family != path.stem:
        raise InputError(
            f"{path}: family: {found.family}: expected the file's name, {path.stem}"
        )
    own = [key for key in (*ELEMENTS, "agent") if key in spec]
    if found.compound and own:
        raise InputError(f"{path}: compound: with {own[0]}: expected either, not both")
    perception: dict[str, float | str | None] = dict.fromkeys(PERCEPTION, 0.0)
    return Family(
        name=found.family,
        title=found.title,
        source=found.source,
        cases=found.cases,
        path=str(path),
        parameters=tuple(
            _parameter(path, name, row) for name, row in found.parameters.items()
        ),
        derived={
            name: _expression(path, f"derived.{name}", text)
            for name, text in found.derived.items()
        },
        road=_fields(path, "road", found.road, ROAD),
        elements={
            key: tuple(_element(path, key, row) for row in getattr(found, key))
            for key in ELEMENTS
        },
        agents=tuple(_agent(path, row) for row in found.agent),
        perception=_fields(path, "perception", found.perception, perception),
        compound=tuple(found.compound),
    )


def _known(path: Path, where: str, row: Mapping, allowed: set[str]) -> None:
    for key in row:
        if key not in allowed:
            raise InputError(
                f"{path}: {where}{key}: unknown: expected {', '.join(sorted(allowed))}"
            )


def _parameter(path: Path, name: str, row: object) -> Parameter:
    where = f"{path}: parameters.{name}"
    if not name.isidentifier():
        raise InputError(f"{where}: expected a name")
    found = checked(row, _Drawn, where)
    chosen = [key for key in DISTRIBUTIONS if getattr(found, key) is not None]
    if len(chosen) != 1:
        raise InputError(f"{where}: {chosen}: expected one of {DISTRIBUTIONS}")
    if found.per not in ("case", "event"):
        raise InputError(f"{where}: per: {found.per}: expected case or event")
    if found.clip is not None and not found.clip[0] <= found.clip[1]:
        raise InputError(f"{where}: clip: {found.clip}: expected [low, high]")
    return Parameter(
        name=name,
        distribution=chosen[0],
        arguments=tuple(getattr(found, chosen[0])),
        clip=found.clip,
        per_case=found.per == "case",
        unit=found.unit,
        meaning=found.meaning,
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
    found = checked(row, _Agent, f"{path}: agent")
    special = {"when", *found.__struct_fields__}
    rest = {name: value for name, value in row.items() if name not in special}
    optional = {
        key: rest.pop(key) for key in (*DRIVER, "length", "width") if key in rest
    }
    fields = _fields(path, "agent", rest, AGENT)
    for key, value in optional.items():
        fields[key] = _expression(path, f"agent.{key}", value)
    return AgentSpec(
        kind=_one_of(path, "agent.kind", found.kind, KINDS),
        model=_one_of(path, "agent.model", found.model, MODELS),
        when=_when(path, "agent", row),
        flags={key: getattr(found, key) for key in FLAGS},
        fields=fields,
        phases=_triples(path, "agent.phases", found.phases),
        moves=_triples(path, "agent.moves", found.moves),
    )


def _triples(
    path: Path, where: str, rows: Sequence[Triple]
) -> tuple[tuple[Expression, ...], ...]:
    return tuple(
        tuple(_expression(path, where, value) for value in row) for row in rows
    )
