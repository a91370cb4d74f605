"""Lanes estimated from tracks lie where the true ones do, linked as they are."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy.spatial import KDTree

from rcirl_jax.data.plans import changes_of_lane
from rcirl_jax.data.roads import roads_from_tracks
from rcirl_jax.data.scenes.lanes import LaneGraph, project
from rcirl_jax.types import Recording
from tests.data.formats.fixtures.drives import straight
from tests.helpers.driven_roads import crossing, dense, late_exit, motorway

DRIVEN = {
    "a motorway": motorway(),
    "a crossing": crossing(),
    "a late exit": late_exit(),
}


@functools.cache
def roads_of(name):
    return roads_from_tracks(DRIVEN[name].tracks)


@pytest.fixture(params=DRIVEN)
def case(request):
    return request.param, DRIVEN[request.param], roads_of(request.param)


def chain_near(lanes, line):
    """Points of the lanes that head along a line, joined."""
    ways = np.gradient(line, axis=0)
    tree, parts = KDTree(line), []
    for lane in lanes:
        apart, at = tree.query(lane.centre)
        own = np.gradient(lane.centre, axis=0)
        cosine = np.sum(own * ways[at], axis=1)
        cosine /= np.hypot(*own.T) * np.hypot(*ways[at].T)
        parts.append(lane.centre[(apart < 1.7) & (cosine > 0.85)])
    return np.concatenate(parts)


def test_every_true_lane_is_found_within_0_3_m(case):
    name, driven, roads = case
    for lane, line in driven.lanes.items():
        found = KDTree(chain_near(roads.lanes, line))
        apart = found.query(line[5:-5])[0]
        share = np.mean(apart < 0.6)  # points of a lane are a metre apart
        assert share > 0.95, (name, lane, share)
        # across: the distance less what lies along
        inner = line[5:-5]
        way = np.gradient(inner, axis=0)
        way /= np.hypot(*way.T)[:, None]
        gap = found.data[found.query(inner)[1]] - inner
        left = way[:, 0] * gap[:, 1] - way[:, 1] * gap[:, 0]
        assert np.percentile(np.abs(left), 90) < 0.3, (name, lane)


def test_there_is_no_lane_that_nobody_drives_on(case):
    _, driven, roads = case
    every = KDTree(np.concatenate([dense(line) for line in driven.lanes.values()]))
    points = [lane.centre[1:-1] for lane in roads.lanes if len(lane.centre) > 2]
    apart = every.query(np.concatenate(points))[0]
    # but where one lane comes onto another
    assert np.mean(apart < 0.3) > 0.9
    assert roads.explained > 0.97


def test_widths_and_neighbours(case):
    name, _, roads = case
    by_id = {lane.id: lane for lane in roads.lanes}
    width = 3.5
    if name == "a crossing":
        assert np.isnan(roads.width)
        assert all(lane.left is lane.right is None for lane in roads.lanes)
        return
    # a short way beside each other tells less of the width
    least, off = {"a motorway": (3, 0.1), "a late exit": (1, 0.2)}[name]
    assert roads.width == pytest.approx(width, abs=off)
    long = [x for x in roads.lanes if len(x.centre) > 60]
    pairs = [(x, by_id[x.left]) for x in long if x.left]
    assert len(pairs) >= least
    for right, left in pairs:
        middle = right.centre[len(right.centre) // 2]
        way = np.gradient(right.centre, axis=0)[len(right.centre) // 2]
        gap = left.centre[KDTree(left.centre).query(middle)[1]] - middle
        across = (way[0] * gap[1] - way[1] * gap[0]) / np.hypot(*way)
        assert across == pytest.approx(width, abs=0.4)


def test_a_crossing_leads_to_three_arms():
    lines, roads = DRIVEN["a crossing"].lanes, roads_of("a crossing")
    reached = roads_reached(roads, roads_lane_at(roads, lines["0 on"][5]))
    for end in ("0 on", "0 left", "0 right"):
        assert roads_lane_at(roads, lines[end][-5]).id in reached, end


def graph_of(roads):
    options = {"name": "made", "source": "made", "licence": "MIT", "rate_hz": 12.5}
    return LaneGraph(Recording(**options, tracks=(), lanes=roads.lanes))


@pytest.mark.parametrize(
    ("lane", "at", "side"), [("slip", -1, "left"), ("2", 0, "right")]
)
def test_a_lane_ends_or_begins_beside_another(lane, at, side):
    """It is no fork and no join: who merges changes lanes."""
    lines, roads = DRIVEN["a motorway"].lanes, roads_of("a motorway")
    last = roads_lane_at(roads, lines[lane][at + (5 if at == 0 else -4)])
    if at:
        assert last.successors == ()
    else:
        assert all(last.id not in other.successors for other in roads.lanes)
    assert getattr(last, side) is not None
    end, true = last.centre[at], lines[lane]
    assert np.hypot(*(end - true[at])) < 70.0
    way = np.diff(last.centre, axis=0)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(way[:, 1], way[:, 0]))))
    assert np.max(turn / np.hypot(*way[1:].T)) < 0.01  # 1/m, no swerve


@pytest.mark.parametrize(("name", "least"), [("a motorway", 60), ("a late exit", 20)])
def test_changes_of_lane_are_found_where_they_are(name, least):
    driven, graph = DRIVEN[name], graph_of(roads_of(name))
    found = {x.id: changes_of_lane(x, graph) for x in driven.tracks}
    true = {x.id: [] for x in driven.tracks}
    for name, place in driven.changes:
        true[name].append(place)
    hits = sum(
        any(np.hypot(*(place - other)) < 40.0 for other in found[name])
        for name, place in driven.changes
    )
    assert len(driven.changes) > least
    assert hits >= 0.95 * len(driven.changes)
    assert hits >= 0.95 * sum(len(places) for places in found.values())


def test_who_merges_is_described_along_the_lane_that_ends():
    """The line goes on beside the road, and its room closes."""
    driven, roads = DRIVEN["a motorway"], roads_of("a motorway")
    graph = graph_of(roads)
    chain = graph.chain(roads_lane_at(roads, driven.lanes["slip"][300]).id, ())
    frame = graph.frame(chain)
    s, left = project(frame, *driven.lanes["0"][200:700].T)
    assert np.all(np.diff(s) > 0.5)
    assert s[-1] < frame.length
    assert np.median(left) == pytest.approx(3.5, abs=0.15)
    assert np.ptp(left) < 0.8
    stations = s[[50, -100]]
    assert frame.table("road_right", stations) == pytest.approx([-1.75, 1.75], abs=0.2)
    assert np.max(np.abs(frame.kappa[20 : int(frame.length) - 20])) < 0.006


def roads_lane_at(roads, place):
    return min(roads.lanes, key=lambda lane: KDTree(lane.centre).query(place)[0])


def roads_reached(roads, lane):
    by_id, found, todo = {x.id: x for x in roads.lanes}, set(), [lane.id]
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            todo += by_id[name].successors
    return found


def test_lane_numbers_of_the_log_name_the_lanes():
    driven = motorway(minutes=3.0)
    changed = {name for name, _ in driven.changes}
    tracks = [t for t in driven.tracks if t.id not in changed]
    lines = [KDTree(driven.lanes[name]) for name in ("0", "1", "exit")]
    labels = [
        np.argmin([line.query(np.stack([t.x, t.y], 1))[0] for line in lines], axis=0)
        for t in tracks
    ]
    names = [np.array(["5", "7", "9"])[label] for label in labels]
    roads = roads_from_tracks(tracks, labels=names)
    assert {lane.id.partition(".")[0] for lane in roads.lanes} == {"5", "7", "9"}


def test_a_lap_closes():
    """Three laps of 1,885 m: lanes that lead back to their start."""
    radius, t = 300.0, np.arange(0.0, 3.2 * 2 * np.pi * 15.0, 0.1)
    jitter = 0.05 * np.random.default_rng(0).normal(size=(2, t.size))
    places = radius * np.array([np.cos(t / 15.0), np.sin(t / 15.0)]) + jitter
    user = dataclasses.replace(
        straight(t, (0.0, 0.0), 0.0, 20.0),
        **{"x": places[0], "y": places[1], "heading": t / 15.0 + np.pi / 2},
    )
    roads = roads_from_tracks([user])
    assert roads_reached(roads, roads.lanes[0]) == {lane.id for lane in roads.lanes}
    lanes = {lane.id: lane for lane in roads.lanes}
    name, seen = roads.lanes[0].id, []
    while name not in seen:
        seen.append(name)
        (name,) = lanes[name].successors
    steps = [np.hypot(*np.diff(lane.centre, axis=0).T) for lane in roads.lanes]
    assert 1870.0 < sum(step.sum() for step in steps) < 1930.0
    assert max(step.max() for step in steps) < 26.0
