"""Metrics of a drive: one Record -> one CaseMetrics, pure and vmappable.

The paper's six columns are counted per case (every sample holds) and per
sample, with raw jerk, the plain difference at 10 Hz, and with nuPlan's
filtered jerk, which hides short pulses (a one-step pulse keeps 10 %). nuPlan's
score follows its devkit's constants. Only `record.valid` samples count; a
drive that ended in an at-fault collision fails every per-case column.
"""

import dataclasses
import functools
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rcirl_jax.simulation.cases import STEP_S, Record

FILTER_ORDER = 2  # of the polynomials of Savitzky-Golay filters

COLUMNS = (
    "collision_free",
    "speed_limit",
    "a_station",
    "a_lateral",
    "j_station",
    "j_lateral",
)
# fields of CaseMetrics that count
COUNTED = (
    *("samples", "collisions", "at_fault", "at_fault_vru", "at_fault_object"),
    *("red_lights", "stop_signs", "brake_taps"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MetricsConfig:
    """Thresholds; the paper's, nuPlan's and the usual surrogate measures'."""

    # m/s of numerical slack above the posted limit
    speed_slack: float = 0.1
    max_acceleration: float = 4.0  # m/s^2 (the paper, Apollo Dreamland)
    max_jerk: float = 6.0  # m/s^3 (the paper)
    ttc_threshold: float = 1.5  # s, of TET and TIT
    tap_change: float = 1.0  # m/s^2, change of acceleration of a brake tap
    tap_window_s: float = 2.0  # s within which the sign turns back
    standing: float = 0.2  # m/s (Apollo)
    creeping_limit: float = 0.2  # 1, share of the posted limit below which one creeps
    creeping_way: float = 40.0  # m, free ahead, where to creep is nobody's doing
    turning_band: float = 0.1  # m/s^2, |a| below which a sign of it does not count
    starting: float = 1.0  # m/s below which a drive begins with a start
    started: float = 0.8  # 1, share of the posted limit at which a start is over
    # --- nuPlan (reference: its devkit) ---
    nuplan_ttc: float = 0.95  # s
    nuplan_overspeed: float = 2.23  # m/s
    nuplan_off_road: float = 0.3  # m
    min_longitudinal: float = -4.05  # m/s^2
    max_longitudinal: float = 2.40  # m/s^2
    max_lateral: float = 4.89  # m/s^2
    max_longitudinal_jerk: float = 4.13  # m/s^3
    max_total_jerk: float = 8.37  # m/s^3
    max_yaw_rate: float = 0.95  # rad/s
    max_yaw_acceleration: float = 1.93  # rad/s^2
    acceleration_window: int = 8  # samples
    jerk_window: int = 15  # samples


class CaseMetrics(flax.struct.PyTreeNode, kw_only=True):
    """Numbers of one drive; all scalars unless said."""

    samples: jax.Array  # valid samples
    inside: jax.Array  # [6] valid samples inside the bound, per column
    holds: jax.Array  # [6] bool, every sample inside and no at-fault crash
    inside_filtered: jax.Array  # [2] the jerk columns with filtered jerk
    holds_filtered: jax.Array  # [2] bool
    collisions: jax.Array  # agents hit, whoever's fault
    at_fault: jax.Array  # of them by the ego's fault
    at_fault_vru: jax.Array  # of them pedestrians and cyclists
    at_fault_object: jax.Array  # of them static objects
    impact_speed: jax.Array  # m/s, largest
    red_lights: jax.Array  # lights run
    stop_signs: jax.Array  # stop signs run
    off_road: jax.Array  # m, farthest
    progress: jax.Array  # m
    mean_speed: jax.Array  # m/s
    standing_share: jax.Array  # 1
    creeping_share: jax.Array  # 1, slow or standing with a free road ahead
    start_time: jax.Array  # s, longest start on a free road; -1 if none
    sign_changes: jax.Array  # 1/s, turns of the acceleration from push to brake or back
    min_ttc: jax.Array  # s, inf if none
    tet: jax.Array  # s, time with TTC below the threshold
    tit: jax.Array  # s^2, integral of (threshold - TTC)
    min_headway: jax.Array  # s, inf if none
    min_clearance: jax.Array  # m, inf if none
    induced_braking: jax.Array  # m/s^2, hardest braking the ego caused
    brake_taps: jax.Array  # number
    fallback_share: jax.Array  # 1, samples under a fallback plan
    min_a: jax.Array  # m/s^2
    max_a: jax.Array  # m/s^2
    rms_a: jax.Array  # m/s^2
    max_a_lateral: jax.Array  # m/s^2
    max_j: jax.Array  # m/s^3, largest |jerk|
    rms_j: jax.Array  # m/s^3
    max_j_lateral: jax.Array  # m/s^3
    # nuPlan's parts; `nuplan_score` needs a reference distance
    no_fault: jax.Array  # 0, 0.5 or 1
    drivable: jax.Array  # 0 or 1
    direction: jax.Array  # 0, 0.5 or 1
    ttc_bound: jax.Array  # 0 or 1
    speed_compliance: jax.Array  # 0 to 1
    comfort: jax.Array  # 0 or 1


def without_lost(metrics: CaseMetrics) -> CaseMetrics:
    """Puts numbers in place of drives [C] that are at no number: not driven.

    Such a case has no samples, holds no bound, makes no progress and has no score.

    Args:
      metrics: leaves [C, ...], numpy.
    """
    lost = ~np.isfinite(metrics.progress) | ~np.isfinite(metrics.mean_speed)
    stands = {"min_ttc": np.inf, "min_headway": np.inf, "min_clearance": np.inf}
    stands = {**stands, "start_time": -1.0}
    values = {}
    for name, value in vars(metrics).items():
        value = np.asarray(value)
        at = lost.reshape(-1, *[1] * (value.ndim - 1))
        values[name] = np.where(at, value.dtype.type(stands.get(name, 0)), value)
    return CaseMetrics(**values)


def not_driven(metrics: CaseMetrics) -> np.ndarray:
    """[C] bool: cases that were not driven, as `without_lost` has them."""
    return np.asarray(metrics.samples) == 0


def differences(x: jax.Array) -> jax.Array:
    """Plain rate of change [S] per second at 10 Hz; the first sample has none."""
    return jnp.diff(x, prepend=x[:1]) / STEP_S


@functools.cache
def _least_squares(window: int, derivative: int) -> np.ndarray:
    """Weights [window] of the least-squares parabola's derivative at the middle."""
    x = np.arange(window) - window // 2
    rows = np.linalg.pinv(np.vander(x, FILTER_ORDER + 1, increasing=True))
    return rows[derivative] * np.prod(range(1, derivative + 1)) / STEP_S**derivative


def savitzky_golay(
    x: Float[Array, "n s"], filters: Sequence[tuple[int, int]]
) -> Float[Array, "n f s"]:
    """Smooth signals, or differentiate them by time; ends hold their values.

    Savitzky-Golay filters (1964) of order 2 as one convolution. nuPlan judges comfort
    through them: accelerations over 8 samples, jerks over 15. A window of 8 has no
    middle sample; like scipy 1.11 and later, an even window is taken as the next odd
    one.

    Args:
      x: [n, S] n signals, a sample every `STEP_S`.
      filters: f pairs (window in samples, derivative 0 or 1).
    """
    longest = max(window | 1 for window, _ in filters)
    kernels = np.zeros((len(filters), 1, longest))
    for kernel, (window, derivative) in zip(kernels, filters, strict=True):
        aside = (longest - (window | 1)) // 2
        kernel[0, aside : longest - aside] = _least_squares(window | 1, derivative)
    padded = jnp.pad(x, ((0, 0), (longest // 2, longest // 2)), mode="edge")
    return jax.lax.conv_general_dilated(
        padded[:, None], jnp.asarray(kernels, x.dtype), (1,), "VALID"
    )


def case_metrics(record: Record, config: MetricsConfig) -> CaseMetrics:
    """All metrics of one drive.

        a_lateral = v^2 * curvature of the path driven, at the centre of gravity
        j = difference of consecutive samples / 0.1 s

    What is summed over valid samples stands in one array, and so does what the largest
    is taken of: a program compiles as long as it has loops.

    Args:
      record: leaves [S].
      config: thresholds; static.
    """
    valid = record.valid
    a_lateral = record.v**2 * record.curvature
    yaw_rate = record.v * record.curvature
    j, j_lateral = differences(record.a), differences(a_lateral)
    filtered = savitzky_golay(
        jnp.stack([record.a, a_lateral, yaw_rate]),
        (
            (config.acceleration_window, 0),
            (config.jerk_window, 0),
            (config.jerk_window, 1),
        ),
    )
    (smooth_a, _, smooth_j), (smooth_across, _, smooth_j_lateral) = filtered[:2]
    yaw, yaw_a = filtered[2, 1], filtered[2, 2]
    below = jnp.maximum(config.ttc_threshold - record.ttc, 0.0)
    over = jnp.maximum(record.v - record.speed_limit, 0.0)
    second = round(1.0 / STEP_S)
    backward = jnp.pad(record.s[:-second] - record.s[second:], (second, 0))
    gentle = (
        (smooth_a > config.min_longitudinal)
        & (smooth_a < config.max_longitudinal)
        & (jnp.abs(smooth_across) < config.max_lateral)
        & (jnp.abs(smooth_j) < config.max_longitudinal_jerk)
        & (jnp.hypot(smooth_j, smooth_j_lateral) < config.max_total_jerk)
        & (jnp.abs(yaw) < config.max_yaw_rate)
        & (jnp.abs(yaw_a) < config.max_yaw_acceleration)
    )
    bounds = [
        record.at_fault == 0,
        record.v < record.speed_limit + config.speed_slack,
        jnp.abs(record.a) < config.max_acceleration,
        jnp.abs(a_lateral) < config.max_acceleration,
        jnp.abs(j) < config.max_jerk,
        jnp.abs(j_lateral) < config.max_jerk,
        jnp.abs(smooth_j) < config.max_jerk,
        jnp.abs(smooth_j_lateral) < config.max_jerk,
        record.ttc > config.nuplan_ttc,
        gentle,
    ]
    slow = record.v < config.creeping_limit * record.speed_limit
    start_time, turns = _starts_and_turns(record, config)
    summed = {
        "samples": jnp.ones_like(record.v),
        "collisions": record.collision,
        "at_fault": record.at_fault,
        "at_fault_vru": record.at_fault_vru,
        "at_fault_object": record.at_fault_object,
        "red_lights": record.red_light,
        "stop_signs": record.stop_sign,
        "brake_taps": _brake_taps(record, config),
        "v": record.v,
        "standing": record.v < config.standing,
        "creeping": slow & (record.free_way > config.creeping_way),
        "tet": below > 0.0,
        "tit": below,
        "fallback": record.fallback,
        "a2": record.a**2,
        "j2": j**2,
        "over": over,
    }
    rows = jnp.stack([x.astype(jnp.float32) for x in (*summed.values(), *bounds)])
    sums = jnp.sum(jnp.where(valid, rows, 0.0), axis=1)
    total = dict(zip(summed, sums, strict=False))
    inside = sums[len(summed) :]
    counted = {name: total[name].astype(jnp.int32) for name in COUNTED}
    free = counted["at_fault"] == 0
    holds = (inside == total["samples"]) & free
    largest = {
        "impact_speed": record.impact_speed,
        "off_road": record.off_road,
        "progress": record.s,
        "induced_braking": record.induced_braking,
        "max_a": record.a,
        "max_a_lateral": jnp.abs(a_lateral),
        "max_j": jnp.abs(j),
        "max_j_lateral": jnp.abs(j_lateral),
        "backward": backward,
        "min_a": -record.a,
        "min_ttc": -record.ttc,
        "min_headway": -record.headway,
        "min_clearance": -record.clearance,
    }
    rows = jnp.where(valid, jnp.stack(list(largest.values())), -jnp.inf)
    top = dict(zip(largest, jnp.max(rows, axis=1), strict=True))
    count = jnp.maximum(total["samples"], 1.0)
    objects = counted["at_fault_object"]
    others = counted["at_fault"] - objects
    worst = top["backward"]
    number = lambda x: x.astype(jnp.float32)  # noqa: E731
    return CaseMetrics(
        **counted,
        inside=inside[:6].astype(jnp.int32),
        holds=holds[:6],
        inside_filtered=inside[6:8].astype(jnp.int32),
        holds_filtered=holds[6:8],
        **{
            name: jnp.maximum(top[name], 0.0)
            for name in ("impact_speed", "off_road", "progress", "induced_braking")
        },
        mean_speed=total["v"] / count,
        standing_share=total["standing"] / count,
        creeping_share=total["creeping"] / count,
        start_time=start_time,
        sign_changes=turns / (count * STEP_S),
        tet=total["tet"] * STEP_S,
        tit=total["tit"] * STEP_S,
        fallback_share=total["fallback"] / count,
        rms_a=jnp.sqrt(total["a2"] / count),
        rms_j=jnp.sqrt(total["j2"] / count),
        **{
            name: top[name]
            for name in ("max_a", "max_a_lateral", "max_j", "max_j_lateral")
        },
        **{
            name: -top[name]
            for name in ("min_a", "min_ttc", "min_headway", "min_clearance")
        },
        no_fault=jnp.where(others > 0, 0.0, jnp.maximum(1.0 - 0.5 * objects, 0.0)),
        drivable=number(top["off_road"] < config.nuplan_off_road),
        direction=jnp.where(worst < 2.0, 1.0, jnp.where(worst <= 6.0, 0.5, 0.0)),
        ttc_bound=number(holds[8]),
        speed_compliance=jnp.maximum(
            1.0 - total["over"] / (config.nuplan_overspeed * count), 0.0
        ),
        comfort=number(holds[9]),
    )


def _starts_and_turns(
    record: Record, config: MetricsConfig
) -> tuple[jax.Array, jax.Array]:
    """Longest start [s] on a free road, -1 if none; and how often a turns its sign.

    A start begins at the first sample at which the ego stands, or that the drive
    begins with below 1 m/s, and from which on the road is free as for
    `creeping_share`; it ends where 80 % of the posted limit is reached, or else with
    the record. One in which the road is free no longer does not count.

    The acceleration turns where, beyond the band, it has another sign than when it was
    last beyond it.
    """
    is_free = record.free_way > config.creeping_way
    reached = record.v >= config.started * record.speed_limit
    first = jnp.arange(record.v.size) == 0
    begins = (record.v < config.standing) | (first & (record.v < config.starting))
    sign = jnp.sign(record.a) * (jnp.abs(record.a) > config.turning_band)
    sign = jnp.where(record.valid, sign, 0.0)

    def follow(carry: tuple, now: tuple) -> tuple[tuple, None]:
        since, longest, last, turns = (
            carry  # samples since the start began; -1: in none
        )
        valid, free, there, stands, push = now
        lasts = jnp.where(since >= 0, since + 1, jnp.where(stands, 0, -1))
        is_over = valid & there & (since >= 0)
        longest = jnp.where(is_over, jnp.maximum(longest, lasts), longest)
        lasts = jnp.where(free & ~there, lasts, -1)
        since = jnp.where(valid, lasts, since)
        turns = turns + (push * last < 0.0)
        return (since, longest, jnp.where(push != 0.0, push, last), turns), None

    none = jnp.full_like(record.collision[0], -1)
    begin = (none, none, jnp.zeros_like(sign[0]), none + 1)
    samples = (record.valid, is_free, reached, begins, sign)
    (since, longest, _, turns), _ = jax.lax.scan(follow, begin, samples)
    found = jnp.maximum(since, longest)  # a start may last to the record's end
    return jnp.where(found < 0, -1.0, found * STEP_S), turns


def _brake_taps(record: Record, config: MetricsConfig) -> jax.Array:
    """Samples [S] at which a turns by more than 1 m/s^2 through 0 within 2 s."""
    back = round(config.tap_window_s / STEP_S)
    a = record.a
    recent = jax.lax.reduce_window(
        a, -jnp.inf, jax.lax.max, (back,), (1,), [(back - 1, 0)]
    )
    braking = (a < 0.0) & (recent > 0.0) & (recent - a > config.tap_change)
    return braking & ~jnp.concatenate([jnp.zeros((1,), bool), braking[:-1]])


def nuplan_score(
    metrics: CaseMetrics, reference: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(score, progress ratio), nuPlan's formula; elementwise.

        score = no_fault * drivable * making_progress * direction
                * (5 progress + 5 ttc + 4 speed + 2 comfort) / 16

    Args:
      metrics: of the drives.
      reference: m, the distance the reference driver made in the same case.
    """
    ratio = jnp.minimum(
        jnp.maximum(metrics.progress, 2.0) / jnp.maximum(reference, 2.0), 1.0
    )
    weighted = (
        5.0 * ratio
        + 5.0 * metrics.ttc_bound
        + 4.0 * metrics.speed_compliance
        + 2.0 * metrics.comfort
    ) / 16.0
    makes_progress = ratio >= 0.2
    gate = metrics.no_fault * metrics.drivable * metrics.direction * makes_progress
    return gate * weighted, ratio
