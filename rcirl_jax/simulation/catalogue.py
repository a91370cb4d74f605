"""From a family and a number to a case: the same on every machine.

The parameters of case i are point i of a Sobol sequence over all parameters
and events of the family, rotated by a shift of the family's name and the seed
(Cranley and Patterson 1976), so that any number of cases spreads evenly from
easy to hard and a case does not depend on how many are made. What is not a
parameter (ordinary drivers, the draw of a compound's events) comes from a
numpy stream of its own per case. All of it is float64 on the host and becomes
float32 at the end.
"""

import functools
import hashlib
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_LINES,
    NUM_ROAD,
    ROAD_STEP_M,
    STEP_S,
    Case,
    LineKind,
    Perception,
    agents_of,
    lines_of,
    node,
)
from rcirl_jax.simulation.families import (
    STATIONS,
    AgentSpec,
    Element,
    Family,
    Parameter,
    Parts,
    family_names,
    load_family,
    road_of,
)
from rcirl_jax.types import Kind
from rcirl_jax.units import EGO_LENGTH_M, EGO_WIDTH_M

__all__ = [
    "build_case",
    "build_cases",
    "case_id",
    "family_names",
    "load_family",
    "parameters_of",
    "parse_case_id",
]


def draw_driver(rng: np.random.Generator, speed_limit: float) -> dict[str, float]:
    """One driver's parameters by the names of `Driver`.

    Uniform draws and inverse distribution functions only, so that the stream
    is the same under every numpy.
    """
    u = np.clip(rng.random(8), 1e-6, 1.0 - 1e-6)
    share = float(np.clip(1.0 + 0.1 * ndtri(u[0]), 0.7, 1.3))
    headway = float(np.clip(1.4 * np.exp(0.3 * ndtri(u[1])), 0.6, 3.0))
    spread = lambda i, low, high: float(low + (high - low) * u[i])  # noqa: E731
    return {
        "desired": share * speed_limit,
        "headway": headway,
        "standstill": spread(2, 1.0, 4.0),
        "acceleration": spread(3, 0.8, 2.5),
        "braking": spread(4, 1.5, 3.5),
        "delay": spread(5, 0.2, 0.8),
        "politeness": spread(6, 0.0, 0.5),
        "threshold": spread(7, 0.1, 0.3),
        "lapse_start": np.inf,
        "lapse_end": np.inf,
    }


MAX_EVENTS = 8  # events of a case
MAX_COPIES = 1000  # of an agent, before `when` chooses
MAX_LANES = 100  # beside the ego's
SIZES = {  # m, length and width by kind
    "vehicle": (4.6, 1.9),
    "cyclist": (1.8, 0.6),
    "pedestrian": (0.5, 0.5),
    "static": (4.6, 1.9),
}
HEADINGS = {"lane": 0.0, "oncoming": math.pi}  # rad; crossing has its own
ID = re.compile(r"^([A-Za-z0-9_]+)/(\d{1,6})@(\d{1,9})$")


def case_id(family: str, index: int, seed: int) -> str:
    """Name of a case, for example "cut_in/017@0"."""
    return f"{family}/{index:03d}@{seed}"


def case_number(name: str) -> int:
    """`Case.seed` of a case by its id."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")


def parse_case_id(text: str) -> tuple[str, int, int]:
    """(family, index, seed) of a case's name.

    Raises:
      InputError: it is not one.
    """
    found = ID.match(text)
    if found is None:
        raise InputError(f"case: {text}: expected FAMILY/INDEX@SEED: cut_in/017@0")
    return found[1], int(found[2]), int(found[3])


def _stream(name: str, *numbers: int) -> np.random.Generator:
    text = "/".join([name, *(str(number) for number in numbers)])
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "big")))


@functools.lru_cache(maxsize=256)
def _points(name: str, seed: int, dimensions: int, log2: int) -> np.ndarray:
    """[2^log2, d] points in (0, 1), evenly spread and rotated."""
    sobol = qmc.Sobol(dimensions, scramble=False).random_base2(log2)
    shift = _stream(name, seed).random(dimensions)
    return np.clip(np.mod(sobol + shift, 1.0), 1e-6, 1.0 - 1e-6)


def _uniforms(family: Family, index: int, seed: int) -> np.ndarray:
    per_case = sum(p.per_case for p in family.parameters)
    per_event = len(family.parameters) - per_case
    dimensions = max(per_case + MAX_EVENTS * per_event, 1)
    log2 = max(8, int(index).bit_length())
    return _points(family.name, seed, dimensions, log2)[index]


def _draw(parameter: Parameter, u: float) -> float:
    """The parameter's value at quantile u."""
    a = parameter.arguments
    if parameter.distribution == "uniform":
        value = a[0] + (a[1] - a[0]) * u
    elif parameter.distribution == "choice":
        value = a[min(int(u * len(a)), len(a) - 1)]
    elif parameter.distribution == "normal":
        value = a[0] + a[1] * float(ndtri(u))
    else:
        value = a[0] * math.exp(a[1] * float(ndtri(u)))
    if parameter.clip is not None:
        value = min(max(value, parameter.clip[0]), parameter.clip[1])
    return float(value)


class _Draws:
    """All parameters of one case of one family."""

    def __init__(self, family: Family, uniforms: np.ndarray) -> None:
        self.family = family
        fixed = [p for p in family.parameters if p.per_case]
        self.changing = [p for p in family.parameters if not p.per_case]
        pairs = zip(fixed, uniforms, strict=False)
        self.case = {p.name: _draw(p, u) for p, u in pairs}
        self.rest = uniforms[len(fixed) :]

    def event(self, number: int) -> dict[str, float]:
        first = number * len(self.changing)
        part = self.rest[first : first + len(self.changing)]
        own = {p.name: _draw(p, u) for p, u in zip(self.changing, part, strict=True)}
        return {**self.case, **own}


def _derive(family: Family, variables: dict[str, float], strict: bool) -> None:
    """Add the derived values in order; not strict: those that can be made."""
    for name, expression in family.derived.items():
        if strict or expression.names <= variables.keys() | {"pi", "inf"}:
            variables[name] = expression(variables)


def _wanted(item: Element | AgentSpec, variables: Mapping[str, float]) -> bool:
    return item.when is None or bool(item.when(variables))


def _add_elements(family: Family, variables: dict[str, float], parts: Parts) -> None:
    values = {
        kind: [
            (element, {k: e(variables) for k, e in element.fields.items()})
            for element in elements
            if _wanted(element, variables)
        ]
        for kind, elements in family.elements.items()
    }
    for _, f in values["curve"]:
        ramp = max(min(f["ramp"], 0.5 * f["length"]), ROAD_STEP_M)
        rise = np.minimum(STATIONS - f["at"], f["at"] + f["length"] - STATIONS) / ramp
        parts.kappa += f["kappa"] * np.clip(rise, 0.0, 1.0)
    parts.limits += [(f["at"], f["speed"]) for _, f in values["limit"]]
    parts.shifts += [(f["at"], f["length"], f["l"]) for _, f in values["shift"]]
    parts.routes += [tuple(f.values()) for _, f in values["route"]]
    for element, f in values["line"]:
        kind = LineKind.LIGHT if element.kind == "light" else LineKind.STOP_SIGN
        parts.lines.append({**f, "s": f["at"], "kind": kind})


def _add_agents(
    family: Family,
    variables: dict[str, float],
    parts: Parts,
    rng: np.random.Generator,
) -> None:
    for spec in family.agents:
        count = spec.fields["count"](variables)
        if not count <= MAX_COPIES:
            raise InputError(
                f"{family.path}: agent.count: {count:g}: expected at most {MAX_COPIES}"
            )
        for copy in range(int(count)):
            own = {**variables, "i": float(copy)}
            if not _wanted(spec, own):
                continue
            agent: dict[str, Any] = dict(draw_driver(rng, variables["speed_limit"]))
            length, width = SIZES[spec.kind]
            agent |= {"length": length, "width": width}
            agent |= {k: e(own) for k, e in spec.fields.items() if k != "count"}
            if spec.model != "crossing":
                agent["heading"] = HEADINGS[spec.model]
            agent |= dict(spec.flags)
            agent["kind"] = int(Kind[spec.kind.upper()])
            agent["phases"] = [[e(own) for e in row] for row in spec.phases]
            agent["moves"] = [[e(own) for e in row] for row in spec.moves]
            parts.agents.append(agent)


def _events(
    family: Family,
    draws: _Draws,
    shared: dict[str, float],
    road: dict[str, float],
    rng: np.random.Generator,
    index: int,
    seed: int,
) -> Parts:
    """Play through the events along the road."""
    parts = Parts(
        kappa=np.zeros(NUM_ROAD), limits=[], shifts=[], routes=[], lines=[], agents=[]
    )
    members = {}
    for event in range(int(road["events"])):
        source, own = family, draws.event(event)
        if family.compound:
            pick = int(rng.random() * len(family.compound))
            source = load_family(family.compound[pick])
            if source.name not in members:
                members[source.name] = _Draws(source, _uniforms(source, index, seed))
            own = {**members[source.name].event(event), **draws.case}
        variables = {
            **own,
            **shared,
            "start": road["first"] + event * road["spacing"],
            "event": float(event),
        }
        _derive(source, variables, strict=True)
        _add_elements(source, variables, parts)
        _add_agents(source, variables, parts, rng)
    return parts


def _check(family: Family, name: str, road: dict[str, float], parts: Parts) -> None:
    """One line for what no case may be."""
    where = f"{family.path}: {name}"
    found = {
        "agents": (len(parts.agents), NUM_AGENTS),
        "lines": (len(parts.lines), NUM_LINES),
    }
    for what, (count, most) in found.items():
        if count > most:
            raise InputError(f"{where}: {what}: {count}: expected at most {most}")
    for agent in parts.agents:
        starts = [row[0] for row in agent["phases"]]
        if any(b <= a for a, b in itertools.pairwise(starts)):
            raise InputError(f"{where}: agent.phases: {starts}: expected to rise")
        if any(row[2] <= 0.0 for row in [*agent["phases"], *agent["moves"]]):
            raise InputError(f"{where}: agent: rate: expected above 0")


def build_case(
    family: Family, index: int, seed: int = 0, *, duration_s: float = 120.0
) -> Case:
    """Case `index` of a family; numpy leaves.

    Raises:
      InputError: an expression fails, or there is more than fits (names file,
        case and count).
    """
    with as_input_error(family.path, "a case that can be made"):
        return _built(family, index, seed, duration_s)


def _built(family: Family, index: int, seed: int, duration_s: float) -> Case:
    draws = _Draws(family, _uniforms(family, index, seed))
    rng = _stream(f"{family.name}/streams", seed, index)
    variables = dict(draws.case) | {"ego_length": EGO_LENGTH_M}
    _derive(family, variables, strict=False)
    road: dict[str, float] = {}
    for key in ("ego_speed", "speed_limit", "lane_width"):
        road[key] = family.road[key]({**variables, **road})
    shared = {**road, "ego_length": EGO_LENGTH_M}
    for key, expression in family.road.items():
        if key not in road:
            road[key] = expression({**variables, **shared})
    if not 0 <= road["events"] <= MAX_EVENTS:
        raise InputError(
            f"{family.path}: {case_id(family.name, index, seed)}: events: "
            f"{road['events']:g}: expected at most {MAX_EVENTS}"
        )
    for key in ("lanes_left", "lanes_right", "oncoming"):
        if not 0 <= road[key] <= MAX_LANES:
            raise InputError(
                f"{family.path}: road.{key}: {road[key]:g}: expected 0 to {MAX_LANES}"
            )
    parts = _events(family, draws, shared, road, rng, index, seed)
    _check(family, case_id(family.name, index, seed), road, parts)
    f = np.float32
    return node(
        Case,
        seed=np.uint32(case_number(case_id(family.name, index, seed))),
        steps=np.int32(round(duration_s / STEP_S)),
        ego_v=f(road["ego_speed"]),
        ego_length=f(EGO_LENGTH_M),
        ego_width=f(EGO_WIDTH_M),
        road=road_of(road, parts),
        lines=lines_of(parts.lines),
        agents=agents_of(parts.agents),
        perception=node(
            Perception,
            **{k: f(e({**variables, **shared})) for k, e in family.perception.items()},
        ),
    )


def build_cases(
    family: Family,
    indices: Sequence[int],
    seed: int = 0,
    *,
    duration_s: float = 120.0,
) -> Case:
    """Cases of a family stacked [B, ...]; numpy leaves."""
    cases = [build_case(family, i, seed, duration_s=duration_s) for i in indices]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *cases)


def parameters_of(family: Family, index: int, seed: int = 0) -> dict[str, float]:
    """The drawn parameters: per-case by name, per-event as name[0], name[1], ..."""
    draws = _Draws(family, _uniforms(family, index, seed))
    found = dict(draws.case)
    names = [p.name for p in draws.changing]
    for event in range(MAX_EVENTS):
        values = draws.event(event)
        found |= {f"{name}[{event}]": values[name] for name in names}
    return found
