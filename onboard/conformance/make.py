"""Writes `cases.txt` and its weights files: scenes, and what JAX says of candidates.

    python -m onboard.conformance.make [FOLDER]

The same code gives the same scenes; answers of other versions of JAX may differ in the
last digits. README.md says how a case reads.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import numpy.typing as npt

from rcirl_jax.export.own_planner.builder import plain_scene
from rcirl_jax.features import feature_map
from rcirl_jax.planner.safety import SafetyConfig, explain
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.types import Kind, Scene
from rcirl_jax.units import NUM_STATIONS, TIMES_S
from tests.helpers import drawn_scenes, own_planner
from tests.helpers.own_planner import drawn_reward, entries, jax_answers
from tests.helpers.scenes import scene

HERE = Path(__file__).parent
REWARDS = {"paper21": False, "apollo21": True}  # preset, scene gating
DRAWN = 8  # random scenes
HEAD = "# Made by onboard/conformance/make.py; README.md says how it reads.\n"
UNTIL = np.arange(TIMES_S.size) < 9  # a light's first half
LINE = {"length": 0.1, "width": 40.0, "kind": Kind.STOP}
LEAD = {"s": 30.0, "speed": 8.0}
BEHIND = {"l": 3.6}  # in the lane on the left
ENTERS_L = 3.6 * np.clip(TIMES_S / 4.0, 0.0, 1.0)  # m, of who goes there


def hand_made() -> dict[str, Scene]:
    """Scenes of one matter each, on a straight road unless said otherwise."""
    return {
        "free_road": scene(),
        "standing": scene(v=0.0, boxes=[{"s": 8.0}]),
        "bend": scene(kappa=0.02, l=1.0, path_l=0.5, boxes=[LEAD]),
        "tight_bend": scene(v=4.0, kappa=0.19, l=5.0),
        "follow": scene(boxes=[LEAD]),
        "overtaken": scene(v=5.0, boxes=[{"s": -20.0, "speed": 15.0}]),
        "beside": scene(boxes=[{"s": 5.0, "l": 3.5, "speed": 12.0}]),
        "oncoming": scene(boxes=[{"s": 90.0, "l": 3.4, "speed": -12.0}]),
        "pedestrian": scene(boxes=[{"s": 25.0, "l": -1.5, "length": 0.6, "kind": 3}]),
        "parked": scene(boxes=[{"s": 20.0, "l": -2.0, "kind": Kind.STATIC}]),
        "sides_touch": scene(boxes=[{"s": 0.0, "l": 1.9, "speed": 13.0}]),
        "two_alike": scene(boxes=[LEAD, {**LEAD, "speed": 7.0, "s": 30.0}]),
        "red_light": scene(boxes=[{"s": 35.0, **LINE}]),
        "light_turns_green": scene(boxes=[{"s": 40.0, "valid": UNTIL, **LINE}]),
        "light_turns_red": scene(boxes=[{"s": 40.0, "valid": ~UNTIL, **LINE}]),
        "over_the_line": scene(v=2.0, boxes=[{"s": 1.0, **LINE}]),
        "destination": scene(boxes=[{"s": 50.0, **LINE, "kind": Kind.VIRTUAL}]),
        "gaps": scene(boxes=[{**LEAD, "valid": np.arange(TIMES_S.size) % 3 > 0}]),
        "short_horizon": scene(num_valid=6, boxes=[LEAD]),
        "one_time": scene(num_valid=1, boxes=[LEAD]),
    }


def cases() -> Iterator[tuple[str, Scene]]:
    """Names and scenes, numpy leaves."""
    for name, made in hand_made().items():
        yield name, jax.tree.map(np.asarray, made)
    drawn = drawn_scenes.scenes(np.random.default_rng(0), DRAWN)
    for n in range(DRAWN):
        yield f"drawn_{n}", jax.tree.map(lambda x, n=n: x[n], drawn)
    for name, made in unsafe().items():
        yield name, jax.tree.map(np.asarray, made)


def unsafe() -> dict[str, Scene]:
    """Scenes whose candidates break the filter's rules, each one first."""
    return {
        "braking_leader": scene(boxes=[{"s": 25.0, "speed": 3.0}]),
        "too_near": scene(v=20.0, boxes=[{"s": 12.0, "speed": 20.0}]),
        "narrow_road": narrow(scene(v=20.0)),
        "over_the_limit": scene(speed_limit=8.0),
        "sharp_bend": scene(v=20.0, kappa=0.03),
        "crossing": scene(boxes=[{"s": 40.0, "l": -1.2, "length": 0.6, "kind": 3}]),
        "enters_too_near": scene(v=20.0, boxes=[{**BEHIND, "s": -14.0, "speed": 20.0}]),
        "enters_with_room": scene(v=5.0, boxes=[{**BEHIND, "s": -38.0, "speed": 10.0}]),
    }


def narrow(made: Scene) -> Scene:
    """A road whose right edge comes near from 30 m on."""
    right = np.where(np.arange(NUM_STATIONS) < 15, -5.4, -0.5).astype(np.float32)
    return made.replace(path=made.path.replace(road_right=right))


def rulings(made: Scene, s: np.ndarray, l: np.ndarray | None) -> np.ndarray:
    """Reason, obstacle and time [K, 3] in JAX; -1: no obstacle, no one time.

    With offsets the rule about lanes that are entered counts too.
    """
    kept = [n for n, kind in enumerate(made.obstacles.kind) if is_there(made, n, kind)]
    config = SafetyConfig(entry=l is not None)
    found = explain(made, own_planner.candidates(made, s, l), config)
    reason, obstacle, time = (np.asarray(x) for x in found)
    # places among the obstacles of the plain scene, which has no empty slots
    place = np.array([kept.index(n) if n >= 0 else -1 for n in obstacle.tolist()])
    return np.stack([reason, place, np.where(np.isfinite(time), time, -1.0)], axis=1)


def is_there(made: Scene, n: int, kind: int) -> bool:
    """True if `plain_scene` keeps the slot."""
    return kind != Kind.NONE and bool(np.any(made.obstacles.valid[n]))


def line(label: str, numbers: npt.ArrayLike) -> str:
    """A label and numbers, each as short as float32 allows."""
    texts = (f"{float(x):.9g}" for x in np.asarray(numbers, np.float32))
    return " ".join([label, *texts])


def main(folder: Path) -> None:
    """Write the three files."""
    text, rewards = [HEAD], {}
    for preset, scene_gating in REWARDS.items():
        columns = feature_map(preset)
        path = folder / f"{preset}.msgpack"
        reward = drawn_reward(path, columns, scene_gating=scene_gating)
        rewards[preset] = (columns, reward)
    for number, (name, made) in enumerate(cases()):
        preset = tuple(REWARDS)[number % 2]
        columns, reward = rewards[preset]
        one = jax.tree.map(lambda x: x[None], made)
        s, l = drawn_scenes.candidates(np.random.default_rng(number), one, 2)
        s = np.concatenate([made.ego.v * TIMES_S[None, None], s], axis=1)
        l = None if number % 3 == 0 else np.concatenate([l[:, :1], l], axis=1)
        if l is not None and name.startswith("enters"):
            l[:, 0] = ENTERS_L
        features, values = (x[0] for x in jax_answers(columns, reward, one, s, l))
        ways = (s[0], None if l is None else l[0])
        text += [f"case {name}", f"weights {preset}.msgpack"]
        text.append(" ".join(["columns", *reward.names]))
        text += [line(*entry) for entry in entries(plain_scene(made), *ways)]
        text.append("answer")
        text += [line("features", row) for way in features for row in way]
        text += [line("scores", values), line("rulings", rulings(made, *ways).ravel())]
        text += ["end", ""]
    write_whole(folder / "cases.txt", "\n".join(text).encode())
    print(f"written: {folder / 'cases.txt'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
