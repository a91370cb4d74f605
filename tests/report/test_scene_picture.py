"""The picture of a recorded scene shows what its arrays say."""

import dataclasses

import jax
import numpy as np
import pytest
from matplotlib import pyplot

from rcirl_jax.data.store.rows import row_spec
from rcirl_jax.errors import InputError
from rcirl_jax.report.data import scene_picture
from rcirl_jax.report.data.scene_picture import draw_scene
from rcirl_jax.types import Decision, Kind, Tag
from rcirl_jax.units import TIMES_S

CAR, LIGHT, PEDESTRIAN, FAR = range(4)  # slots
TIMES = TIMES_S.size


def scene(**changes):
    """A car ahead at 8 m/s, a stop line, a pedestrian aside, somebody far ahead."""
    rows = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), row_spec())
    path, obstacles = rows.scene.path, rows.scene.obstacles
    shape, grid = obstacles.s_lower.shape, path.l.shape
    kind, decisions = np.zeros(shape[0], np.int32), np.zeros(shape[0], np.int32)
    kind[:4] = Kind.VEHICLE, Kind.STOP, Kind.PEDESTRIAN, Kind.VEHICLE
    decisions[:4] = Decision.FOLLOW, Decision.STOP, Decision.NUDGE_LEFT, Decision.IGNORE
    s = np.zeros(shape, np.float32)
    s[CAR], s[LIGHT], s[PEDESTRIAN], s[FAR] = 20.0 + 8.0 * TIMES_S, 70.0, 30.0, 400.0
    l = np.zeros(shape, np.float32)
    l[PEDESTRIAN] = -2.5
    half = np.where(kind == Kind.STOP, 0.0, 2.0)[:, None].astype(np.float32)
    tags = np.zeros(len(Tag), bool)
    tags[[Tag.FOLLOWING, Tag.STOPPING]] = True
    valid = np.broadcast_to((kind != Kind.NONE)[:, None], shape).copy()
    full = lambda value: np.full(grid, value, np.float32)  # noqa: E731
    change = dataclasses.replace
    speed = np.float32(8.0)
    human = change(
        rows.human, s=(speed * TIMES_S).astype("f4"), v=np.full(TIMES, speed)
    )
    ego = change(rows.scene.ego, v=speed, length=np.float32(4), width=np.float32(2))
    path = change(
        path, speed_limit=full(13.9), lane_left=full(1.75), lane_right=full(-1.75),
        road_left=full(5.25), road_right=full(-1.75),
    )  # fmt: skip
    obstacles = change(
        obstacles, s_lower=s - half, s_upper=s + half, l_lower=l - 1.0,
        l_upper=l + 1.0, valid=valid, kind=kind,
    )  # fmt: skip
    made = change(
        rows.scene, ego=ego, tags=tags, time_valid=TIMES_S < 6.3, path=path,
        obstacles=obstacles,
    )  # fmt: skip
    return change(
        rows, scene=change(made, **changes), human=human, decisions=decisions,
        future_s=np.float32(6.4),
    )  # fmt: skip


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """The figure of a scene, before it is saved."""
    kept = []
    monkeypatch.setattr(scene_picture, "save", lambda made, _: kept.append(made))
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
