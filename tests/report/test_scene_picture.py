"""The picture of a recorded scene shows what its arrays say."""

import jax
import numpy as np
import pytest
from matplotlib import pyplot

from rcirl_jax.errors import InputError
from rcirl_jax.report import scene as scene_module
from rcirl_jax.report.scene import draw_scene
from rcirl_jax.types import Decision, Kind
from rcirl_jax.units import TIMES_S
from tests.helpers import scenes

CAR, LIGHT, PEDESTRIAN, FAR = range(4)  # slots
TIMES = TIMES_S.size


def scene(**changes):
    """A car ahead at 8 m/s, a stop line, a pedestrian aside, somebody far ahead."""
    usual = {"length": 4.0, "width": 2.0}
    boxes = [
        {**usual, "s": 20.0, "speed": 8.0},
        {**usual, "s": 70.0, "length": 0.0, "kind": Kind.STOP},
        {**usual, "s": 30.0, "l": -2.5, "kind": Kind.PEDESTRIAN},
        {**usual, "s": 400.0},
    ]
    made = scenes.scene(v=8.0, speed_limit=13.9, boxes=boxes)
    made = made.replace(**{"time_valid": TIMES_S < 6.3, **changes})
    made = jax.tree.map(np.array, made)
    rows, decisions = scenes.demonstration(0), np.zeros(len(made.obstacles.kind), int)
    decisions[:4] = Decision.FOLLOW, Decision.STOP, Decision.NUDGE_LEFT, Decision.IGNORE
    human = jax.tree.map(np.zeros_like, rows.human)
    human = human.replace(s=(8.0 * TIMES_S).astype("f4"), v=np.full(TIMES, 8.0, "f4"))
    return rows.replace(scene=made, human=human, decisions=decisions)


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """The figure of a scene, before it is saved."""
    kept = []
    monkeypatch.setattr(scene_module, "save", lambda made, _: kept.append(made))
    yield lambda rows: (draw_scene(tmp_path / "a.png", rows, 7), kept[-1])[1]
    for made in kept:
        pyplot.close(made)


def of_slot(axis, slot):
    name = f"slot {slot}"
    return [artist for artist in axis.get_children() if artist.get_gid() == name]


def test_boxes_and_bars_stand_where_the_obstacles_are(drawn):
    rows = scene()
    above, graph = drawn(rows).axes[:2]
    (box,) = of_slot(above, CAR)
    assert box.get_bbox().bounds == pytest.approx((-1.0, 18.0, 2.0, 4.0))
    (line,) = of_slot(above, LIGHT)
    np.testing.assert_allclose(line.get_ydata(), [70.0, 70.0])
    left, right = above.get_xlim()
    assert left > right  # left of the road is left on the paper
    valid = rows.scene.time_valid
    human = [line for line in graph.lines if line.get_color() == "#000000"]
    np.testing.assert_allclose(human[0].get_ydata(), rows.human.s[valid])
    (bars,) = of_slot(graph, CAR)
    ends = np.array([path.vertices for path in bars.get_paths()])
    np.testing.assert_allclose(ends[:, 0, 0], TIMES_S[valid], rtol=1e-6)
    for side, name in enumerate(("s_lower", "s_upper")):
        wanted = getattr(rows.scene.obstacles, name)[CAR][valid]
        np.testing.assert_allclose(ends[:, side, 1], wanted)
    assert not of_slot(graph, PEDESTRIAN)  # beside the driver's path


def test_what_cannot_be_drawn_is_one_line(tmp_path):
    bad = scene()
    bad.human.s[2] = np.nan
    with pytest.raises(InputError, match=r"scene 7: human\.s: not finite: expected"):
        draw_scene(tmp_path / "a.png", bad, 7)
    never = scene(time_valid=np.zeros(TIMES, bool))
    with pytest.raises(InputError, match=r"scene 7: time_valid: 0 valid times"):
        draw_scene(tmp_path / "a.png", never, 7)
    assert not list(tmp_path.iterdir())
    path = draw_scene(tmp_path / "new" / "scene.png", scene(), 7)
    assert path.read_bytes().startswith(b"\x89PNG")
