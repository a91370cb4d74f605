"""Moments of drives: the planner's step, the scenario families, other simulators."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from benchmarks.common import untrained
from benchmarks.drawings.ideas import OTHER, bare, rectangle
from rcirl_jax.export.closed_loop import incumbent_score, table_rows
from rcirl_jax.export.loading import open_reward
from rcirl_jax.features import feature_map
from rcirl_jax.planner.rank import ONLINE, RankConfig
from rcirl_jax.planner.safety import check
from rcirl_jax.report.frames import draw_obstacles
from rcirl_jax.report.player import COLOURS
from rcirl_jax.report.replays import MAX_CASES, Replay, make_replays
from rcirl_jax.report.style import (
    CANDIDATE,
    CHOSEN,
    CLASS_COLOURS,
    figure,
    label,
    save,
)
from rcirl_jax.sampling import sample
from rcirl_jax.simulation.catalogue import family_names
from rcirl_jax.simulation.rollout import SPAN, RolloutConfig, drive_cases
from rcirl_jax.simulation.rows import baseline_row
from rcirl_jax.simulation.suite import CaseRef, build, case_ref, catalogue_set
from rcirl_jax.simulators.drive import Driver, Seen
from rcirl_jax.simulators.simulators import View, open_simulator
from rcirl_jax.types import Scene
from rcirl_jax.units import TIMES_S

PLANNED_CASE, PLANNED_S = "cut_in/017@0", 30.0  # case and s of `planner`
FAMILY_S = 40.0  # s of a drive of `family_views`


def planner(path: Path, weights: str) -> None:
    """One planning step in four panels, at the step where the filter refuses most."""
    (row, *_), reward = table_rows([weights], []), open_reward(weights)
    cases = build([case_ref(PLANNED_CASE)], PLANNED_S)
    config = RolloutConfig(steps=round(10 * PLANNED_S), frames_every=SPAN)
    *_, frames = drive_cases(row.policy, row.params, cases, config)
    frames = jax.tree.map(lambda x: x[0], frames)

    @jax.jit
    @jax.vmap
    def look(scene: Scene) -> tuple:
        candidates = sample(jax.random.key(0), scene, ONLINE)
        verdict = check(scene, candidates, RankConfig().safety)
        x = feature_map(reward.preset).of_candidates(scene, candidates)
        own, fields = incumbent_score(reward.prior_cost.incumbent)
        return candidates, verdict.admissible, x, own(fields, scene, candidates)

    found = look(frames)
    admitted = np.asarray(found[1]).sum(axis=1)
    step = int(np.argmin(np.where(admitted >= 12, admitted, 99)))
    pick = lambda tree: jax.tree.map(lambda x: np.asarray(x[step]), tree)  # noqa: E731
    scene = pick(frames)
    candidates, admissible, x, own = pick(found)
    values = reward.total(x, own, np.ones(x.shape[:2], bool))
    chosen = int(np.argmax(np.where(admissible, values, -np.inf)))
    _draw_planner(path, scene, candidates.trajectory.s, admissible, values, chosen)


def _draw_planner(
    path: Path,
    scene: Scene,
    s: np.ndarray,
    admissible: np.ndarray,
    values: np.ndarray,
    chosen: int,
) -> None:
    made, axes = figure(2, 2, 7.6, 6.0)
    order = np.argsort(values)
    rank = np.zeros(len(s))
    rank[order[admissible[order]]] = np.linspace(0.0, 1.0, admissible.sum())
    for number, axis in enumerate(axes.ravel(), 1):
        for k, row in enumerate(s):
            colour, wide, alpha, dash = CANDIDATE, 0.8, 0.7, "-"
            if number >= 3 and not admissible[k]:
                colour, dash, alpha = CLASS_COLOURS["stop"], ":", 0.5
            if number == 4 and admissible[k]:
                colour, wide, alpha = CLASS_COLOURS["follow"], 1.2, 0.1 + 0.8 * rank[k]
            if number == 1 or (number == 4 and not admissible[k]):
                continue
            axis.plot(TIMES_S, row, dash, color=colour, lw=wide, alpha=alpha)
        if number == 4:
            axis.plot(TIMES_S, s[chosen], "--", color=CHOSEN, lw=2.4)
        draw_obstacles(axis, scene)
        axis.set(xlim=(0, 8), ylim=(-15, 1.25 * s.max()))
    count = int(admissible.sum())
    titles = (
        "1. predict: where the others will be in the way",
        f"2. sample: {len(s)} candidates",
        f"3. filter: {len(s) - count} refused (dotted red)",
        "4. choose: the dashed; stronger blue, higher value",
    )
    for axis, title in zip(axes.ravel(), titles, strict=True):
        label(axis, title, "t, s", "station, m")
        axis.set_title(title, fontsize=9, loc="left")
    save(made, path)


def family_views(path: Path) -> None:
    """One moment of a case of every family, from above."""
    names = family_names()
    cases = catalogue_set([CaseRef(family=n, index=0) for n in names], FAMILY_S)
    row = baseline_row("hand-set", "paper21", untrained(), RankConfig())
    replays: list[Replay] = []
    for first in range(0, len(names), MAX_CASES):
        replays += make_replays([row], cases, cases.ids[first : first + MAX_CASES], 1)
    made, axes = figure(6, 4, 8.2, 5.4)
    for axis in axes.ravel():
        bare(axis)
    for axis, replay in zip(axes.ravel(), replays, strict=False):
        _draw_moment(axis, replay)
        axis.set_title(replay.group, fontsize=8, loc="left", pad=2)
    save(made, path)


def _draw_moment(axis: Axes, replay: Replay) -> None:
    """Hardest braking, or without cause the closest; the ego drives to the right."""
    (drive,) = replay.drives
    now = int(np.argmin(drive.a))
    ahead = np.array(drive.agents[now][1::4]) - drive.s[now]
    if not np.any((ahead > 0.0) & (ahead < 40.0)) and not drive.red[now]:
        now = int(np.argmin(np.abs(np.array(drive.t) - drive.start)))
    stations = replay.road_step * np.arange(len(replay.x))

    def placed(s: np.ndarray, l: np.ndarray) -> np.ndarray:
        x, y, turn = (
            np.interp(s, stations, a) for a in (replay.x, replay.y, replay.turn)
        )
        x, y = x - l * np.sin(turn), y + l * np.cos(turn)
        way = np.interp(drive.s[now], stations, replay.turn)
        x0, y0 = (np.interp(drive.s[now], stations, a) for a in (replay.x, replay.y))
        dx, dy = x - x0, y - y0
        return np.stack(
            [dx * np.cos(way) + dy * np.sin(way), dy * np.cos(way) - dx * np.sin(way)],
            -1,
        )

    def body(s: float, l: float, heading: float, size: tuple, colour: str) -> None:
        box = rectangle(-0.5 * size[0], -0.5 * size[1], *size)
        turn = np.array(
            [[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]]
        )
        at = np.array([s, l]) + box @ turn
        axis.add_patch(
            Polygon(placed(at[:, 0], at[:, 1]), color=colour, lw=0.8, zorder=3)
        )

    near = np.linspace(drive.s[now] - 40.0, drive.s[now] + 70.0, 150)
    edges = [placed(near, np.full(150, edge)) for edge in replay.edges]
    axis.fill(*np.concatenate([edges[0], edges[1][::-1]]).T, color="#EEEEEE", zorder=0)
    for mark in replay.marks:
        axis.plot(*placed(near, np.full(150, mark)).T, color=CANDIDATE, lw=0.6, ls="--")
    for number in drive.red[now]:
        ends = placed(np.full(2, replay.lines[number]), np.array(replay.edges))
        axis.plot(*ends.T, color=CLASS_COLOURS["stop"], lw=2)
    span = drive.agents[max(now - 15, 0) : now + 16]
    for slot, (kind, *size) in replay.bodies.items():
        rows = [r for frame in span for r in np.reshape(frame, (-1, 4)) if r[0] == slot]
        if rows:
            axis.plot(*placed(*np.array(rows)[:, 1:3].T).T, color=COLOURS[kind], lw=0.8)
        for _, s, l, heading in (
            r for r in np.reshape(drive.agents[now], (-1, 4)) if r[0] == slot
        ):
            big = tuple(size) if kind != "pedestrian" else (1.4, 1.4)
            body(s, l, heading, big, COLOURS[kind])
    body(drive.s[now], drive.l[now], drive.heading[now], replay.ego, CHOSEN)
    axis.set(xlim=(-24, 46), ylim=(-11, 11), aspect="equal")


def elsewhere(path: Path, weights: str) -> None:
    """The reward driving in highway-env and in SUMO, each after some seconds."""
    row = table_rows([weights], [])[0]
    made, axes = figure(2, 1, 7.6, 3.9)
    moments = (("highway_env", "merge/0/0002", 6.0), ("sumo", "dense/0/0001", 20.0))
    for axis, (name, episode, seconds) in zip(axes[:, 0], moments, strict=True):
        simulator = open_simulator(name)
        running = simulator.start([episode], None)
        seen, driver = Seen(1), Driver(row, [0])
        for _ in range(round(10 * seconds)):
            moves, _ = driver.moves(seen.scenes(running.look())[0])
            running.step(moves)
        (view,) = running.look()
        moves, _ = driver.moves(seen.scenes([view])[0])
        lanes = _highway_lanes(running) if name == "highway_env" else _sumo_lanes()
        _draw_view(axis, view, moves[0].future[:, 1], lanes)
        running.close()
        title = {"highway_env": "highway-env, merge", "sumo": "SUMO, a junction"}[name]
        axis.set_title(title, fontsize=9, loc="left")
    save(made, path)


def _highway_lanes(running: object) -> list[tuple[np.ndarray, float]]:
    (episode,) = running.episodes  # type: ignore[attr-defined]
    found = []
    for lane in episode.road.network.lanes_list():
        along = np.linspace(0.0, lane.length, 60)
        found.append((np.array([lane.position(s, 0.0) for s in along]), lane.width))
    return found


def _sumo_lanes() -> list[tuple[np.ndarray, float]]:
    import libsumo

    names = libsumo.lane.getIDList()
    return [
        (np.array(libsumo.lane.getShape(n)), libsumo.lane.getWidth(n)) for n in names
    ]


def _draw_view(axis: Axes, view: View, plan: np.ndarray, lanes: Sequence) -> None:
    bare(axis)
    ego = view.ego
    for points, width in lanes:
        near = np.abs(points - (ego.x, ego.y)).max() < 2000.0
        if near:
            step = np.gradient(points, axis=0)
            step = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
            aside = 0.5 * width * np.stack([-step[:, 1], step[:, 0]], -1)
            ring = np.concatenate([points + aside, (points - aside)[::-1]])
            axis.add_patch(Polygon(ring, fc="#EEEEEE", ec=CANDIDATE, lw=0.5, zorder=0))
    line = np.asarray(view.centre_line.points)
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    here = way[np.argmin(np.linalg.norm(line - (ego.x, ego.y), axis=1))]
    at = [np.interp(here + plan, way, line[:, i]) for i in range(2)]
    axis.plot(*at, "o-", color=CHOSEN, ms=3, lw=1.2, zorder=2)
    for body, colour in [*((b, OTHER) for b in view.obstacles), (ego, CHOSEN)]:
        box = rectangle(-0.5 * body.length, -0.5 * body.width, body.length, body.width)
        c, s = np.cos(body.heading), np.sin(body.heading)
        at = (body.x, body.y) + box @ np.array([[c, s], [-s, c]])
        axis.add_patch(Polygon(at, color=colour, zorder=3))
    for signal in view.signals:
        red = signal.state in ("red", "stop")
        colour = CLASS_COLOURS["stop" if red else "overtake"]
        axis.plot([signal.x] * 2, [signal.y - 2, signal.y + 2], color=colour, lw=3)
    axis.set(
        xlim=(ego.x - 40, ego.x + 110), ylim=(ego.y - 16, ego.y + 16), aspect="equal"
    )
