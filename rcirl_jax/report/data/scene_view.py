"""A recorded scene as numpy arrays, checked, with the window worth looking at."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from rcirl_jax.data.scenes.manoeuvres import blocking
from rcirl_jax.errors import InputError
from rcirl_jax.types import Decision, Demonstration, Kind, Tag
from rcirl_jax.units import TIMES_S

KIND_WORDS = {
    Kind.VEHICLE: "vehicle",
    Kind.CYCLIST: "cyclist",
    Kind.PEDESTRIAN: "pedestrian",
    Kind.STATIC: "standing object",
    Kind.STOP: "stop line",
    Kind.VIRTUAL: "destination",
}
LINE_KINDS = (Kind.STOP, Kind.VIRTUAL)
BEHIND_M = (12.0, 40.0)  # m behind the ego, at least and at most
AHEAD_M, SPARE_M = 15.0, 40.0  # m beyond the human's end; more for the ignored
LEAST_VIEW_M = 60.0  # m of road that is shown at least


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """One scene as numpy arrays, and the window that is drawn."""

    rows: Demonstration
    blocks: np.ndarray  # [N, T] bool, in the driver's path
    slots: list[int]  # filled slots that are known at some time
    low: float  # m, lowest station drawn
    high: float  # m, highest

    def first(self, slot: int) -> int:
        """Index of the first time at which the slot is known."""
        return int(np.argmax(self.rows.scene.obstacles.valid[slot]))

    def decision(self, slot: int) -> Decision:
        """The label of the slot."""
        return Decision(int(self.rows.decisions[slot]))

    def kind(self, slot: int) -> Kind:
        """What is in the slot."""
        return Kind(int(self.rows.scene.obstacles.kind[slot]))

    def inside(self, slot: int) -> bool:
        """Whether the first box, or a line, lies in the window."""
        at, obstacles = self.first(slot), self.rows.scene.obstacles
        ends = obstacles.s_lower[slot, at], obstacles.s_upper[slot, at]
        return bool(ends[1] >= self.low and ends[0] <= self.high)


def tag_names(demonstration: Demonstration) -> list[str]:
    """Names of the scene's tags in their order, lower case, as in the manifest."""
    tags = np.asarray(demonstration.scene.tags)
    return [tag.name.lower() for tag in Tag if bool(tags[tag])]


def spoken(name: str) -> str:
    """A name of a tag, a decision or a reason as words."""
    return name.replace("_", " ").lower()


def describe_scene(demonstration: Demonstration, row: int) -> str:
    """The scene in words, for those who do not see its picture."""
    view = view_of(demonstration, row)
    human, valid = view.rows.human, view.rows.scene.time_valid
    words = [
        f"Scene {row}, {', '.join(map(spoken, tag_names(view.rows))) or 'no tag'}: "
        f"the human drives {float(human.s[valid][-1]):.0f} m in "
        f"{float(TIMES_S[valid][-1]):.1f} s, from {float(human.v[0]):.1f} to "
        f"{float(human.v[valid][-1]):.1f} m/s."
    ]
    ignored = 0
    for slot in view.slots:
        if view.decision(slot) == Decision.IGNORE:
            ignored += 1
        else:
            name = spoken(view.decision(slot).name)
            words.append(f"{_place(view, slot)}: {name}.")
    words.append(f"{ignored} ignored." if ignored else "Nothing is ignored.")
    return " ".join(words)


def _place(view: View, slot: int) -> str:
    """Kind and place of an obstacle when it is first known."""
    obstacles, at = view.rows.scene.obstacles, view.first(slot)
    s = 0.5 * float(obstacles.s_lower[slot, at] + obstacles.s_upper[slot, at])
    where = f"{abs(s):.0f} m {'ahead' if s >= 0.0 else 'behind'}"
    if view.kind(slot) not in LINE_KINDS:
        l = 0.5 * float(obstacles.l_lower[slot, at] + obstacles.l_upper[slot, at])
        aside = l - float(view.rows.scene.ego.l)
        if abs(aside) > 1.0:
            where += f", {abs(aside):.0f} m to the {'left' if aside > 0 else 'right'}"
    when = f" at {TIMES_S[at]:.1f} s" if at else ""
    return f"{KIND_WORDS[view.kind(slot)].capitalize()} {slot}, {where}{when}"


def view_of(demonstration: Demonstration, row: int) -> View:
    """Numpy arrays of an unbatched demonstration and what to show of it.

    Args:
      demonstration: unbatched.
      row: its number in the dataset, for messages.

    Raises:
      InputError: it holds numbers that are not finite, or no valid time.
    """
    rows = jax.tree.map(np.asarray, demonstration)
    _check(rows, row)
    scene, obstacles = rows.scene, rows.scene.obstacles
    known = (obstacles.kind != Kind.NONE) & obstacles.valid.any(axis=1)
    flat = {f"obstacles.{k}": v for k, v in vars(obstacles).items()}
    flat |= {"path.l": scene.path.l, "ego.width": scene.ego.width}
    slots = np.flatnonzero(known).tolist()
    low, high = _window(rows, slots)
    return View(rows=rows, blocks=blocking(flat), slots=slots, low=low, high=high)


def _check(rows: Demonstration, row: int) -> None:
    """One line for what cannot be drawn."""
    valid, obstacles = rows.scene.time_valid, rows.scene.obstacles
    if valid.ndim != 1 or not valid.any():
        raise InputError(
            f"scene {row}: time_valid: {int(valid.sum())} valid times of shape "
            f"{valid.shape}: expected one scene with at least one"
        )
    used = {f"human.{n}": getattr(rows.human, n)[valid] for n in "slva"}
    known = obstacles.valid & (obstacles.kind != Kind.NONE)[:, None]
    for name in ("s_lower", "s_upper", "l_lower", "l_upper"):
        used[f"obstacles.{name}"] = getattr(obstacles, name)[known]
    used |= {f"path.{name}": leaf for name, leaf in vars(rows.scene.path).items()}
    for name, values in used.items():
        if not np.isfinite(values).all():
            raise InputError(f"scene {row}: {name}: not finite: expected numbers")


def _window(rows: Demonstration, slots: Sequence[int]) -> tuple[float, float]:
    """Stations to draw: the human's way, all that mattered, what fits besides."""
    obstacles = rows.scene.obstacles
    first = np.argmax(obstacles.valid, axis=1)
    number = np.arange(first.size)
    rear, front = obstacles.s_lower[number, first], obstacles.s_upper[number, first]
    matters = [k for k in slots if rows.decisions[k] != Decision.IGNORE]
    end = float(rows.human.s[rows.scene.time_valid].max())
    behind = min([0.0, *(float(rear[k]) - 3.0 for k in slots)])
    low = -min(max(-behind, BEHIND_M[0]), BEHIND_M[1])
    low = min([low, *(float(rear[k]) - 3.0 for k in matters)])
    high = max([end + AHEAD_M, *(float(front[k]) + 5.0 for k in matters)])
    others = max([high, *(float(front[k]) + 5.0 for k in slots)])
    return low, max(min(others, high + SPARE_M), low + LEAST_VIEW_M)
