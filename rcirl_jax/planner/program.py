"""A planner that is a program of its user, in any language: lines of JSON in and out.

    planner:./my_planner --flag          the command after "planner:", without a shell

On start the program is sent one line and answers one; then each scene is a line, and
each plan.

    {"protocol": 1, "times": [18 s], "station_step": 2.0}
                              {"protocol": 1, "name": "my planner", "answer_s": 5.0}
    {"scene": {"ego", "path", "obstacles"}, "case": ID or number, "step": number}
                              {"s": [18 m from the ego's centre], "v": [18], "a": [18]}
                              {"error": "why there is none"}

Names and units of the scene are those of `types.Scene`, with the obstacles that are
there as a list. `answer_s`, `v` and `a` may be left out; then v and a follow from the
stations as everywhere (`sampling.kinematics`). Several processes run at a time, and all
steps of a case go to the same one. The plan is followed as it is: no candidates of
ours, no safety filter, no cost.

A process that dies, is silent for longer than `answer_s` or does not answer a plan is
started anew and asked again. Where that fails too, or the program answers "error", the
plan is NaN, and the case counts as not driven.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import pathlib
import shlex
import shutil
import sys
import threading
import time
from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.planner.plan import Plan, plan_of
from rcirl_jax.runtime.answering import AnsweringProcess, NoAnswer, TooLate
from rcirl_jax.runtime.checked import checked
from rcirl_jax.runtime.user_code import source_sha256
from rcirl_jax.sampling import trajectory_on_path
from rcirl_jax.types import Ego, Obstacles, Path, Scene
from rcirl_jax.units import NUM_TIMES, STATION_STEP_M, TIMES_S, Kind

PROTOCOL = 1
PREFIX = "planner:"  # before the command, wherever a planner is named
START_S = 60.0  # s in which a program has to have started
ANSWER_S = 5.0  # s in which it has to answer, unless it asks for another time
LONGEST_S = 600.0  # s that it may ask for
IN_A_ROW = 3  # failures after which a process is asked no more in a batch
START_M = 0.01  # m by which the first station may be off the ego's centre
BACK_M = 1e-3  # m of rounding by which a station may be behind the one before
SHOWN = 80  # characters of an answer in a line on it
NO_CASE = 2**32 - 1  # number of a scene that is of no case
EXPECTED = 'expected {"s": [18 stations, m]}'
LATER = 'a program may ask for more time on start, by "answer_s" of'
EGO, ROAD = tuple(Ego.__dataclass_fields__), tuple(Path.__dataclass_fields__)
AT_START = ("kind", "a", "l_dot")  # of an obstacle; all else is at the times
BOXES = tuple(x for x in Obstacles.__dataclass_fields__ if x not in AT_START)


class _Hello(msgspec.Struct):
    protocol: int
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    answer_s: Annotated[float, msgspec.Meta(gt=0.0, le=LONGEST_S)] = ANSWER_S


class _Answer(msgspec.Struct):
    s: list[float] | None = None
    v: list[float] | None = None
    a: list[float] | None = None
    error: str | None = None


def is_program(name: str) -> bool:
    """True for what names a program that plans."""
    return name.startswith(PREFIX)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """A program that plans; small, hashable, can be sent to other processes."""

    command: str
    name: str  # as it calls itself
    answer_s: float
    sha256: str  # of the files that the command names, and what they import


class Refused(InputError):
    """A program has said by "error" that it has no plan."""


@functools.cache
def program(place: str) -> Program:
    """Starts a program once, to know its name.

    Args:
      place: its command, with or without "planner:".

    Raises:
      InputError: no such program, or one that does not speak the protocol.
    """
    command = place.removeprefix(PREFIX).strip()
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"{command}: {error}: expected a command") from error
    if not words:
        raise InputError(f"planner: {command!r}: expected a command")
    total = hashlib.sha256(command.encode())
    for word in words:
        file = pathlib.Path(shutil.which(word) or word)
        with contextlib.suppress(OSError):
            if file.is_file():
                total.update(source_sha256(file).encode())
    process, hello = _started(command)
    process.end()
    return Program(
        command=command,
        name=hello.name,
        answer_s=hello.answer_s,
        sha256=total.hexdigest(),
    )


def _started(command: str) -> tuple[AnsweringProcess, _Hello]:
    """Starts a program and greets it."""
    about = {
        "protocol": PROTOCOL,
        "times": [float(t) for t in TIMES_S],
        "station_step": STATION_STEP_M,
    }
    expected = f'expected {{"protocol": {PROTOCOL}, "name": "..."}}'
    try:
        process = AnsweringProcess(shlex.split(command))
        said = process.ask_line(msgspec.json.encode(about), START_S)
    except OSError as error:
        raise InputError(
            f"{command}: {error.strerror}: expected a program that can be started, "
            "or FILE.py:FUNCTION or FILE.so of an own cost"
        ) from error
    except NoAnswer as error:
        raise InputError(f"{command}: on start: {error}: {expected}") from error
    where = f"{command}: on start"
    try:
        hello = checked(_parsed(said, where, expected), _Hello, where)
        if hello.protocol != PROTOCOL:
            raise InputError(f"{where}: protocol: {hello.protocol}: {expected}")
    except InputError:
        process.end()
        raise
    return process, hello


def _parsed(line: bytes, where: str, expected: str) -> object:
    try:
        return json.loads(line)
    except ValueError as error:
        said = line[:SHOWN].decode(errors="replace")
        said += " ..." if len(line) > SHOWN else ""
        raise InputError(f"{where}: {said!r}: {expected}") from error


def scene_line(scene: Scene, case: str | int | None, step: int) -> bytes:
    """Writes what a program is sent of one scene.

    Args:
      scene: numpy leaves. Numbers that are not finite become null.
      case: the case's id or number, if it is of one.
      step: of the case, 0.1 s each.
    """
    o = scene.obstacles
    boxes = {name: np.asarray(getattr(o, name)).tolist() for name in BOXES}
    there = np.flatnonzero((o.kind != Kind.NONE) & np.asarray(o.valid).any(axis=1))
    others = [
        {
            "kind": Kind(int(o.kind[i])).name,
            **{name: values[i] for name, values in boxes.items()},
            "a": float(o.a[i]),
            "l_dot": float(o.l_dot[i]),
        }
        for i in there.tolist()
    ]
    sent = {
        "ego": {name: float(getattr(scene.ego, name)) for name in EGO},
        "path": {name: getattr(scene.path, name).tolist() for name in ROAD},
        "obstacles": others,
    }
    return msgspec.json.encode({"scene": sent, "case": case, "step": step})


def plan_in(line: bytes, where: str) -> np.ndarray:
    """Reads an answer: s, v and a [3, T] of it; v and a are NaN where not given.

    Args:
      line: of a program.
      where: program, case and step, stand before messages.

    Raises:
      Refused: the program has no plan, and says why.
      InputError: no plan that could be followed; names the value.
    """
    found = checked(_parsed(line, where, EXPECTED), _Answer, where)
    if found.error is not None:
        raise Refused(f"{where}: error: {found.error[:SHOWN] or 'no plan'}")
    if found.s is None:
        raise InputError(f"{where}: s: missing: {EXPECTED}")
    made = np.full((3, NUM_TIMES), np.nan, np.float32)
    for row, name in enumerate(("s", "v", "a")):
        values = getattr(found, name)
        if values is None:
            continue
        if len(values) != NUM_TIMES:
            raise InputError(
                f"{where}: {name}: {len(values)} numbers: expected {NUM_TIMES}"
            )
        made[row] = values
        if not np.isfinite(made[row]).all():
            at = int(np.argmin(np.isfinite(made[row])))
            raise InputError(
                f"{where}: {name}[{at}]: {values[at]}: expected a finite number"
            )
    s, v = found.s, found.v
    if abs(s[0]) > START_M:
        raise InputError(
            f"{where}: s[0]: {s[0]:g} m: expected 0: stations are from the ego's centre"
        )
    for at in range(1, NUM_TIMES):
        if s[at] < s[at - 1] - BACK_M:
            raise InputError(
                f"{where}: s[{at}]: {s[at]:g} m after {s[at - 1]:g} m: expected no way "
                "back"
            )
    if v is not None and min(v) < -BACK_M:
        at = int(np.argmin(v))
        raise InputError(f"{where}: v[{at}]: {v[at]:g} m/s: expected no way back")
    return made


_names: dict[int, str] = {}  # of cases that are driven here, by number


def name_cases(names: Mapping[int, str]) -> None:
    """Says how cases are called to programs and in messages, by `Case.seed`."""
    _names.update(names)


@dataclasses.dataclass(kw_only=True)
class _Asked:
    """One scene to answer."""

    line: bytes
    where: str


class _Seat:
    """One process of a program, started when it is needed."""

    def __init__(self, one: Program, tells: "Processes") -> None:
        self._program, self._tells, self._lock = one, tells, threading.Lock()
        self._process: AnsweringProcess | None = None

    def answers(self, asked: list[_Asked]) -> list[np.ndarray | None]:
        """Asks for plans one after the other; None where there is none."""
        made: list[np.ndarray | None] = []
        failures = 0  # in a row
        with self._lock:
            for one in asked:
                answer, tries, why = None, 0, "not asked after failures"
                while answer is None and tries < 2 and failures < IN_A_ROW:
                    tries += 1
                    try:
                        answer, failures = self._answer(one), 0
                    except Refused as error:
                        failures, why = 0, str(error)
                        break
                    except InputError as error:
                        failures, why = failures + 1, str(error)
                        self._tells.failed(why)
                        if self._process is not None:
                            self._process.end()
                        self._process = None
                made.append(answer)
                if answer is None:
                    self._tells.lost(why)
        return made

    def _answer(self, one: _Asked) -> np.ndarray:
        if self._process is None:
            self._process, _ = _started(self._program.command)
        begin = time.perf_counter()
        try:
            said = self._process.ask_line(one.line, self._program.answer_s)
        except NoAnswer as error:
            late = isinstance(error, TooLate)
            more = f"; {LATER} at most {LONGEST_S:g}" if late else ""
            raise InputError(f"{one.where}: {error}: {EXPECTED}{more}") from error
        self._tells.took(time.perf_counter() - begin)
        return plan_in(said, one.where)


class Processes:
    """The processes of a program, as many as there are cores."""

    def __init__(self, one: Program) -> None:
        self._program, count = one, os.cpu_count() or 1
        self._seats = [_Seat(one, self) for _ in range(count)]
        self._threads = concurrent.futures.ThreadPoolExecutor(count)
        self._seconds: list[float] = []
        self.first_lost = ""  # why the first scene that has no plan has none
        self.first_failed = ""  # why a process had to be started anew first
        self._failed = 0
        self._said = False

    def took(self, seconds: float) -> None:
        """Notes how long an answer took."""
        self._seconds.append(seconds)

    def lost(self, why: str) -> None:
        """Notes why a scene has no plan."""
        self.first_lost = self.first_lost or why

    def failed(self, why: str) -> None:
        """Notes why a process is started anew."""
        self.first_failed, self._failed = self.first_failed or why, self._failed + 1

    def say(self) -> None:
        """Prints why the first scene without a plan has none, once."""
        if self.first_lost and not self._said:
            self._said = True
            print(f"not driven: {self.first_lost}", file=sys.stderr)

    def times(self) -> dict[str, float]:
        """Answers so far: their number, failures, and ms that they took."""
        if not self._seconds:
            return {"answers": 0, "failures": self._failed}
        ms = 1e3 * np.asarray(self._seconds)
        return {
            "answers": ms.size,
            "failures": self._failed,
            "median_ms": round(float(np.median(ms)), 3),
            "p99_ms": round(float(np.quantile(ms, 0.99)), 3),
            "longest_ms": round(float(ms.max()), 3),
        }

    def plans(self, scenes: Scene, cases: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Asks for the plans of scenes.

        Scenes of one case and step that are the same are asked about once; one with an
        ego at no number is of a case that is not driven any more.

        Args:
          scenes: numpy leaves [n, ...].
          cases: [n] numbers of their cases.
          steps: [n].

        Returns:
          s, v and a [n, 3, T], NaN where there is no plan.
        """
        made = np.full((len(cases), 3, NUM_TIMES), np.nan, np.float32)
        where_it_goes: dict[bytes, list[int]] = {}
        shares: list[list[_Asked]] = [[] for _ in self._seats]
        places: list[list[bytes]] = [[] for _ in self._seats]
        for i in np.flatnonzero(np.isfinite(scenes.ego.v)).tolist():
            number, step = int(cases[i]), int(steps[i])
            case = None if number == NO_CASE else _names.get(number, number)
            one = jax.tree.map(lambda x, i=i: x[i], scenes)
            line = scene_line(one, case, step)
            if line in where_it_goes:
                where_it_goes[line].append(i)
                continue
            where_it_goes[line] = [i]
            seat = (i if case is None else number) % len(self._seats)
            where = f"{self._program.command}: case {case}, step {step}"
            shares[seat].append(_Asked(line=line, where=where))
            places[seat].append(line)
        work = zip(self._seats, shares, strict=True)
        running = [self._threads.submit(seat.answers, share) for seat, share in work]
        for lines, one in zip(places, running, strict=True):
            for line, answer in zip(lines, one.result(), strict=True):
                if answer is not None:
                    made[where_it_goes[line]] = answer
        return made


_processes: dict[Program, Processes] = {}
_making = threading.Lock()


def processes_of(one: Program) -> Processes:
    """The processes of a program; made once."""
    with _making:
        if one not in _processes:
            _processes[one] = Processes(one)
        return _processes[one]


@dataclasses.dataclass(frozen=True)
class ProgramPolicy:
    """Drives by the plans of a program."""

    program: Program

    def __call__(
        self, params: object, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        """The plan of a scene that is of no case."""
        nothing = jnp.asarray(NO_CASE, jnp.uint32), jnp.asarray(0)
        return self.in_case(params, scene, key, before, *nothing)

    def in_case(
        self,
        params: object,
        scene: Scene,
        key: jax.Array,
        before: Plan | None,
        case: jax.Array,
        step: jax.Array,
    ) -> Plan:
        """The plan of a scene; NaN where the program gives none.

        Args:
          params: none.
          scene: to plan in.
          key: unused, as is the plan in force: a program keeps by itself what it needs.
          before: the plan in force.
          case: [] number of the case.
          step: [] of the case.
        """
        del params, key, before
        shape = jax.ShapeDtypeStruct((3, NUM_TIMES), jnp.float32)

        def asked(*given: Any) -> np.ndarray:  # noqa: ANN401
            scenes, cases, steps = jax.tree.map(np.asarray, given)
            lead = cases.shape
            flat = lambda x: x.reshape(-1, *x.shape[len(lead) :])  # noqa: E731
            processes = processes_of(self.program)
            scenes = jax.tree.map(flat, scenes)
            plans = processes.plans(scenes, flat(cases), flat(steps))
            processes.say()
            return plans.reshape(*lead, 3, NUM_TIMES)

        s, v, a = jax.pure_callback(
            asked, shape, scene, case, step, vmap_method="broadcast_all"
        )
        along = trajectory_on_path(scene, scene.ego.s + s)
        along = along.replace(
            v=jnp.where(jnp.isnan(v), along.v, v), a=jnp.where(jnp.isnan(a), along.a, a)
        )
        return plan_of(along)


def check_program(one: Program, scenes: Scene, cases: np.ndarray) -> None:
    """Asks a program about some scenes, twice; refuses one that does not answer all.

    Args:
      one: the program.
      scenes: numpy leaves [n, ...].
      cases: [n] their numbers.

    Raises:
      InputError: why the first that has no plan has none.
    """
    made = processes_of(one)
    for _ in range(2):
        made.plans(scenes, cases, np.zeros(len(cases), int))
        if why := made.first_failed or made.first_lost:
            raise InputError(why)
