"""Pictures of one simulated drive, from hand-made arrays."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from matplotlib import pyplot
from PIL import Image
from scipy.integrate import solve_ivp

from rcirl_jax.errors import InputError
from rcirl_jax.report.case import picture as case_picture
from rcirl_jax.report.case.drive import (
    on_host,
    plan_start,
    present_at,
    road_in_plane,
    window,
    worst_step,
)
from rcirl_jax.report.case.page import write_case_page
from rcirl_jax.report.case.picture import animate_case, draw_case
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_LINES,
    NUM_ROAD,
    STEP_S,
    Agents,
    AgentState,
    Case,
    LineKind,
    Lines,
    Record,
    Road,
    Snapshot,
)
from rcirl_jax.types import Kind
from rcirl_jax.units import TIMES_S

STEPS = 200
SPEED = 12.0  # m/s
HIT = 150  # step of the crash


def blank(kind, /, **leaves):
    """A node with the given leaves; the others are not read by the pictures."""
    names = [field.name for field in dataclasses.fields(kind)]
    return kind(**({name: np.float32(0) for name in names} | leaves))


def drive(*, bend=0.0, crash=False, planned=1):
    """A car ahead that brakes, a cyclist, a pedestrian, an obstacle and a light."""
    time = (np.arange(STEPS) + 1) * STEP_S
    kappa = np.zeros(NUM_ROAD, np.float32)
    kappa[60:90] = bend
    kind = np.zeros(NUM_AGENTS, np.int32)
    kind[:4] = (Kind.VEHICLE, Kind.CYCLIST, Kind.PEDESTRIAN, Kind.STATIC)
    length, width = np.ones(NUM_AGENTS), np.ones(NUM_AGENTS)
    length[:4], width[:4] = (4.6, 1.8, 0.5, 4.6), (1.9, 0.6, 0.5, 1.9)
    lines = np.zeros(NUM_LINES, np.int32)
    lines[0] = LineKind.LIGHT
    case = blank(
        Case,
        steps=np.int32(STEPS),
        ego_length=np.float32(4.9),
        ego_width=np.float32(2.1),
        road=blank(
            Road,
            kappa=kappa,
            path_l=np.zeros(NUM_ROAD, np.float32),
            lane_width=np.float32(3.5),
            lanes_left=np.int32(1),
            lanes_right=np.int32(0),
            edge_left=np.float32(5.75),
            edge_right=np.float32(-2.25),
        ),
        lines=blank(Lines, kind=lines, s=np.full(NUM_LINES, 190.0)),
        agents=blank(Agents, kind=kind, length=length, width=width),
    )
    s = SPEED * time
    table = lambda fill=0.0: np.full((STEPS, NUM_AGENTS), fill)  # noqa: E731
    state = {"s": table(), "l": table(), "heading": table(), "v": table()}
    state["s"][:, 0] = 60.0 + 9.0 * time
    state["s"][:, 1], state["l"][:, 1] = 20.0 + 5.0 * time, 3.5
    state["s"][:, 2], state["l"][:, 2] = 200.0, 8.0 - 1.0 * time
    state["heading"][:, 2] = -0.5 * np.pi
    state["s"][:, 3], state["l"][:, 3] = 170.0, -1.8
    present, gone = table().astype(bool), table().astype(bool)
    present[:, :4] = True
    clearance = np.abs(state["s"][:, 0] - s) - 4.75 + 3.0
    collision = np.zeros(STEPS, np.int32)
    valid = np.ones(STEPS, bool)
    if crash:
        collision[HIT], valid[HIT + 1 :] = 1, False
        clearance[HIT], present[HIT:, 0], gone[HIT:, 0] = -0.2, False, True
        state["s"][HIT:, 0] = s[HIT] + 4.5
    made = (np.arange(STEPS) // planned) * planned
    begin = np.append(0.0, s)[made]
    record = blank(
        Record,
        valid=valid,
        s=s,
        l=np.zeros(STEPS),
        heading=np.zeros(STEPS),
        v=np.full(STEPS, SPEED),
        a=np.sin(time),
        speed_limit=np.full(STEPS, 13.9),
        clearance=clearance,
        collision=collision,
        at_fault=collision,
    )
    shot = Snapshot(
        agents=blank(AgentState, **state, present=present, gone=gone),
        plan_s=begin[:, None] + 11.0 * TIMES_S[None],
        line_red=np.arange(STEPS)[:, None] * np.ones((1, NUM_LINES)) < 120,
    )
    return case, record, shot


@pytest.fixture(autouse=True)
def _no_figure_stays_open():
    yield
    assert not pyplot.get_fignums()


def test_worst_step_prefers_the_crash():
    _, record, _ = drive(crash=True)
    assert worst_step(record) == HIT
    not_at_fault = record.replace(at_fault=np.zeros(STEPS))
    assert worst_step(not_at_fault) == HIT
    _, record, _ = drive()
    assert worst_step(record) == int(np.argmin(record.clearance))
    late = record.replace(valid=np.arange(STEPS) < 50)
    assert worst_step(late) == int(np.argmin(record.clearance[:50]))
    alone = record.replace(clearance=np.full(STEPS, np.inf))
    assert worst_step(alone) == int(np.argmin(record.a))


def test_road_in_plane_against_an_integrator():
    grid = np.arange(200) * 2.0
    kappa = 0.02 * np.sin(grid / 30.0)
    x, y, heading = road_in_plane(kappa)
    bend = lambda s, z: (  # noqa: E731
        np.cos(z[2]),
        np.sin(z[2]),
        np.interp(s, grid, kappa),
    )
    truth = solve_ivp(
        bend,
        (0.0, grid[-1]),
        (0.0, 0.0, 0.0),
        t_eval=grid,
        rtol=1e-9,
        atol=1e-9,
        max_step=0.5,
    ).y
    np.testing.assert_allclose(heading, truth[2], atol=1e-6)
    # chords are of second order: centimetres after 400 m
    np.testing.assert_allclose(np.stack([x, y]), truth[:2], atol=0.05)
    x, y, heading = road_in_plane(np.full(101, 0.01))
    np.testing.assert_allclose(np.hypot(x, y - 100.0), 100.0, rtol=1e-9)


def test_frenet_points_lie_where_geometry_says():
    case, record, shot = drive()
    circle = case.replace(road=case.road.replace(kappa=np.full(NUM_ROAD, 0.02)))
    host = on_host(None, circle, record, shot)
    angle = np.array([0.0, 0.5, 1.0])
    x, y, line = host.place(30.0 + angle * 50.0, np.array([0.0, 2.0, -3.0]), 30.0)
    radius = 50.0 - np.array([0.0, 2.0, -3.0])
    np.testing.assert_allclose(x, radius * np.sin(angle), atol=0.02)
    np.testing.assert_allclose(y, 50.0 - radius * np.cos(angle), atol=0.02)
    np.testing.assert_allclose(line, angle, atol=1e-9)
    # behind the start the road goes on straight
    x, y, _ = host.place(np.array([-20.0]), np.array([1.0]), 0.0)
    np.testing.assert_allclose([x[0], y[0]], [-20.0, 1.0], atol=1e-9)


def test_the_hit_agent_is_drawn_at_the_crash():
    host = on_host(None, *drive(crash=True))
    assert list(np.flatnonzero(present_at(host, HIT))) == [0, 1, 2, 3]
    assert host.last == HIT
    assert window(host, 3.0, 3.0) == (HIT - 60, HIT)


def test_windows_stay_inside_the_drive():
    case, record, shot = drive()
    for last, worst in ((199, 0), (199, 199), (20, 10), (0, 0)):
        valid = np.arange(STEPS) <= last
        near = np.where(np.arange(STEPS) == worst, 0.0, 9.0)
        host = on_host(None, case, record.replace(valid=valid, clearance=near), shot)
        first, end = window(host, 6.0, 9.0)
        assert 0 <= first <= worst <= end <= last
        assert end - first == min(150, last)


@pytest.mark.parametrize("planned", [1, 5])
def test_plan_starts_when_it_was_made(planned):
    _, record, shot = drive(planned=planned)
    for step in (0, 3, 4, 5, 77, 149):
        made = step // planned * planned * STEP_S
        assert plan_start(record, shot, step) == pytest.approx(made)


@pytest.mark.parametrize(("bend", "crash"), [(0.0, True), (0.02, False)])
def test_png_shows_everything(tmp_path, monkeypatch, bend, crash):
    seen = {}

    def look(made, path):
        made.canvas.draw()
        renderer = made.canvas.get_renderer()
        seen["titles"] = [axis.get_title(loc="left") for axis in made.axes]
        boxes = [axis.get_tightbbox(renderer) for axis in made.axes]
        seen["overlaps"] = [
            (i, j)
            for i, a in enumerate(boxes)
            for j, b in enumerate(boxes[:i])
            if a.overlaps(b) and a.padded(-2.0).overlaps(b.padded(-2.0))
        ]
        legend = made.legends[0].get_window_extent(renderer)
        seen["covered"] = [legend.overlaps(box.padded(-2.0)) for box in boxes]
        seen["units"] = [axis.get_ylabel() for axis in made.axes]
        return save(made, path)

    save = case_picture.save
    monkeypatch.setattr(case_picture, "save", look)
    path = draw_case(*drive(bend=bend, crash=crash), tmp_path / "a" / "case.png", "x")
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert picture.width > 1500
    assert len(seen["titles"]) == 10
    assert sum("<<" in title for title in seen["titles"]) == 1
    assert ("collision" in " ".join(seen["titles"])) == crash
    assert not seen["overlaps"]
    assert not any(seen["covered"])
    assert all(seen["units"])


def test_the_gif_is_short_and_small(tmp_path):
    path = animate_case(*drive(bend=0.02), tmp_path / "case.gif", "a drive")
    assert path.stat().st_size < 3_000_000
    with Image.open(path) as picture:
        frames = picture.n_frames
        shown = 0.0
        for i in range(frames):
            picture.seek(i)
            shown += picture.info["duration"] / 1000.0
    assert 40 <= frames <= 51
    assert shown <= 10.3


def test_the_page_needs_no_other_file(tmp_path):
    parts = drive(crash=True)
    picture = draw_case(*parts, tmp_path / "case.png", "x")
    animation = animate_case(*parts, tmp_path / "case.gif", "x")
    page = write_case_page(
        tmp_path / "case.html",
        "cut_in <17>",
        "One drive.",
        picture=picture,
        animation=animation,
        metrics={"min TTC, s": np.float32(0.51234), "red lights": 2, "note": "<ok>"},
        facts={"git_commit": "abc", "flags": {"row": "<dp>"}},
    )
    text = page.read_text()
    assert "data:image/gif;base64," in text
    assert "data:image/png;base64," in text
    assert "cut_in &lt;17&gt;" in text
    assert re.search(r"min TTC, s\s+0\.5123\n", text)
    assert re.search(r"red lights\s+2\n", text)
    assert "&lt;ok&gt;" in text
    assert "&quot;git_commit&quot;: &quot;abc&quot;" in text
    assert "&quot;row&quot;: &quot;&lt;dp&gt;&quot;" in text
    assert not re.search(r'(src|href)="(?!data:)', text)


def test_bad_input_is_one_line(tmp_path):
    case, record, shot = drive()
    none = record.replace(valid=np.zeros(STEPS, bool))
    with pytest.raises(InputError, match=r"record\.valid: .* 0 valid steps"):
        draw_case(case, none, shot, tmp_path / "x.png", "x")
    batch = jax.tree.map(lambda leaf: np.stack([leaf] * 2), record)
    with pytest.raises(InputError, match="expected one drive"):
        animate_case(case, batch, shot, tmp_path / "x.gif", "x")
    with pytest.raises(InputError, match=r"missing\.png: picture: missing"):
        write_case_page(
            tmp_path / "x.html",
            "x",
            "x",
            picture=tmp_path / "missing.png",
            animation=None,
            metrics={},
            facts={},
        )
