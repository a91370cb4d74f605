"""Metrics of a drive: one Record -> one CaseMetrics, pure and vmappable.

The paper's six columns are counted per case (every sample holds) and per
sample, with raw jerk, the plain difference at 10 Hz, and with nuPlan's
filtered jerk, which hides short pulses (a one-step pulse keeps 10 %). nuPlan's
score follows its devkit's constants. Only `record.valid` samples count; a
drive that ended in an at-fault collision fails every per-case column.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.simulation.cases import STEP_S, Record
from rcirl_jax.simulation.filters import savitzky_golay

COLUMNS = (
    "collision_free",
    "speed_limit",
    "a_station",
    "a_lateral",
    "j_station",
    "j_lateral",
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


def _masked(valid: jax.Array) -> tuple:
    lowest = lambda x: jnp.min(jnp.where(valid, x, jnp.inf))  # noqa: E731
    highest = lambda x: jnp.max(jnp.where(valid, x, -jnp.inf))  # noqa: E731
    total = lambda x: jnp.sum(jnp.where(valid, x, 0))  # noqa: E731
    return lowest, highest, total


def differences(x: jax.Array) -> jax.Array:
    """Plain rate of change [S] per second at 10 Hz; the first sample has none."""
    return jnp.diff(x, prepend=x[:1]) / STEP_S


def case_metrics(record: Record, config: MetricsConfig) -> CaseMetrics:
    """All metrics of one drive.

        a_lateral = v^2 * curvature of the path driven, at the centre of gravity
        j = difference of consecutive samples / 0.1 s

    Args:
      record: leaves [S].
      config: thresholds; static.
    """
    valid = record.valid
    lowest, highest, total = _masked(valid)
    count = jnp.maximum(total(jnp.ones_like(record.v)), 1.0)
    a_lateral = record.v**2 * record.curvature
    j, j_lateral = differences(record.a), differences(a_lateral)
    window = config.jerk_window
    smooth_j = savitzky_golay(record.a, window, derivative=1)
    smooth_j_lateral = savitzky_golay(a_lateral, window, derivative=1)
    fault = total(record.at_fault)
    free = fault == 0
    inside = jnp.stack(
        [
            record.at_fault == 0,
            record.v < record.speed_limit + config.speed_slack,
            jnp.abs(record.a) < config.max_acceleration,
            jnp.abs(a_lateral) < config.max_acceleration,
            jnp.abs(j) < config.max_jerk,
            jnp.abs(j_lateral) < config.max_jerk,
        ]
    )
    smooth = jnp.stack(
        [
            jnp.abs(smooth_j) < config.max_jerk,
            jnp.abs(smooth_j_lateral) < config.max_jerk,
        ]
    )
    ttc = jnp.where(record.ttc_counts, record.ttc, jnp.inf)
    below = jnp.maximum(config.ttc_threshold - ttc, 0.0)
    return CaseMetrics(
        samples=total(jnp.ones_like(record.collision)),
        inside=jax.vmap(total)(inside.astype(jnp.int32)),
        holds=jnp.all(inside | ~valid, axis=1) & free,
        inside_filtered=jax.vmap(total)(smooth.astype(jnp.int32)),
        holds_filtered=jnp.all(smooth | ~valid, axis=1) & free,
        collisions=total(record.collision),
        at_fault=fault,
        at_fault_vru=total(record.at_fault_vru),
        at_fault_object=total(record.at_fault_object),
        impact_speed=jnp.maximum(highest(record.impact_speed), 0.0),
        red_lights=total(record.red_light.astype(jnp.int32)),
        stop_signs=total(record.stop_sign.astype(jnp.int32)),
        off_road=jnp.maximum(highest(record.off_road), 0.0),
        progress=jnp.maximum(highest(record.s), 0.0),
        mean_speed=total(record.v) / count,
        standing_share=total(record.v < config.standing) / count,
        creeping_share=total(
            (record.v < config.creeping_limit * record.speed_limit)
            & (record.free_way > config.creeping_way)
        )
        / count,
        start_time=_start_time(record, config),
        sign_changes=_sign_changes(record, config) / (count * STEP_S),
        min_ttc=lowest(ttc),
        tet=total(below > 0.0) * STEP_S,
        tit=total(below) * STEP_S,
        min_headway=lowest(record.headway),
        min_clearance=lowest(record.clearance),
        induced_braking=jnp.maximum(highest(record.induced_braking), 0.0),
        brake_taps=_brake_taps(record, config),
        fallback_share=total(record.fallback) / count,
        min_a=lowest(record.a),
        max_a=highest(record.a),
        rms_a=jnp.sqrt(total(record.a**2) / count),
        max_a_lateral=highest(jnp.abs(a_lateral)),
        max_j=highest(jnp.abs(j)),
        rms_j=jnp.sqrt(total(j**2) / count),
        max_j_lateral=highest(jnp.abs(j_lateral)),
        **_nuplan(record, a_lateral, ttc, config),
    )


def _start_time(record: Record, config: MetricsConfig) -> jax.Array:
    """Longest time [s] from standstill to 80 % of the posted limit, the road free.

    A start begins at the first sample at which the ego stands, or that the drive
    begins with below 1 m/s, and from which on the road is free as for
    `creeping_share`; it ends where the speed is reached, or else with the record. One
    in which the road is free no longer does not count. -1: no start that counts.
    """
    is_free = record.free_way > config.creeping_way
    reached = record.v >= config.started * record.speed_limit
    first = jnp.arange(record.v.size) == 0
    begins = (record.v < config.standing) | (first & (record.v < config.starting))

    def follow(
        carry: tuple[jax.Array, jax.Array], now: tuple[jax.Array, ...]
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        since, longest = carry  # samples since the start began; -1: in none
        valid, free, there, stands = now
        lasts = jnp.where(since >= 0, since + 1, jnp.where(stands, 0, -1))
        is_over = valid & there & (since >= 0)
        longest = jnp.where(is_over, jnp.maximum(longest, lasts), longest)
        lasts = jnp.where(free & ~there, lasts, -1)
        return (jnp.where(valid, lasts, since), longest), None

    none = jnp.full_like(record.collision[0], -1)
    samples = (record.valid, is_free, reached, begins)
    (since, longest), _ = jax.lax.scan(follow, (none, none), samples)
    found = jnp.maximum(since, longest)  # a start may last to the record's end
    return jnp.where(found < 0, -1.0, found * STEP_S)


def _sign_changes(record: Record, config: MetricsConfig) -> jax.Array:
    """How often a, where beyond the band, has another sign than when last beyond it."""
    sign = jnp.sign(record.a) * (jnp.abs(record.a) > config.turning_band)
    sign = jnp.where(record.valid, sign, 0.0)

    def last(before: jax.Array, now: jax.Array) -> tuple[jax.Array, jax.Array]:
        turned = (now * before) < 0.0
        return jnp.where(now != 0.0, now, before), turned

    _, turned = jax.lax.scan(last, jnp.zeros_like(sign[0]), sign)
    return jnp.sum(turned)


def _brake_taps(record: Record, config: MetricsConfig) -> jax.Array:
    """How often the acceleration turns by more than 1 m/s^2 through 0 within 2 s."""
    back = round(config.tap_window_s / STEP_S)
    a = record.a
    recent = jax.lax.reduce_window(
        a, -jnp.inf, jax.lax.max, (back,), (1,), [(back - 1, 0)]
    )
    braking = (a < 0.0) & (recent > 0.0) & (recent - a > config.tap_change)
    begins = braking & ~jnp.concatenate([jnp.zeros((1,), bool), braking[:-1]])
    return jnp.sum(begins & record.valid, dtype=jnp.int32)


def _nuplan(
    record: Record, a_lateral: jax.Array, ttc: jax.Array, config: MetricsConfig
) -> dict[str, jax.Array]:
    valid = record.valid
    _, highest, total = _masked(valid)
    objects = total(record.at_fault_object)
    others = total(record.at_fault) - objects
    no_fault = jnp.where(others > 0, 0.0, jnp.maximum(1.0 - 0.5 * objects, 0.0))
    over = jnp.maximum(record.v - record.speed_limit, 0.0)
    duration = jnp.maximum(total(jnp.ones_like(over)), 1.0)
    loss = total(over) / (config.nuplan_overspeed * duration)
    second = round(1.0 / STEP_S)
    backward = -(record.s - jnp.roll(record.s, second))
    backward = jnp.where(jnp.arange(backward.size) < second, 0.0, backward)
    worst = highest(backward)
    a = savitzky_golay(record.a, config.acceleration_window)
    across = savitzky_golay(a_lateral, config.acceleration_window)
    j = savitzky_golay(record.a, config.jerk_window, derivative=1)
    j_across = savitzky_golay(a_lateral, config.jerk_window, derivative=1)
    yaw_rate = record.v * record.curvature
    yaw = savitzky_golay(yaw_rate, config.jerk_window)
    yaw_a = savitzky_golay(yaw_rate, config.jerk_window, derivative=1)
    gentle = (
        (a > config.min_longitudinal)
        & (a < config.max_longitudinal)
        & (jnp.abs(across) < config.max_lateral)
        & (jnp.abs(j) < config.max_longitudinal_jerk)
        & (jnp.hypot(j, j_across) < config.max_total_jerk)
        & (jnp.abs(yaw) < config.max_yaw_rate)
        & (jnp.abs(yaw_a) < config.max_yaw_acceleration)
    )
    number = lambda x: x.astype(jnp.float32)  # noqa: E731
    free = total(record.at_fault) == 0
    return {
        "no_fault": no_fault,
        "drivable": number(highest(record.off_road) < config.nuplan_off_road),
        "direction": jnp.where(worst < 2.0, 1.0, jnp.where(worst <= 6.0, 0.5, 0.0)),
        "ttc_bound": number(jnp.all((ttc > config.nuplan_ttc) | ~valid) & free),
        "speed_compliance": jnp.maximum(1.0 - loss, 0.0),
        "comfort": number(jnp.all(gentle | ~valid) & free),
    }


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
