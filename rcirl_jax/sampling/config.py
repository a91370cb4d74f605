"""The sampler's static configuration: every number of the candidate grid."""

import dataclasses

from rcirl_jax.errors import InputError

MODES = ("speed", "path_speed")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SamplerConfig:
    """Grid, jitter and limits of the sampler. Hashable: a static argument.

    Sources: families and 8 s horizon after Apollo's lattice planner
    (cruise, stop, follow, overtake); limits after its constraint checker,
    except that jerk is judged on 0.47 s differences and therefore looser.
    """

    # "speed": along the scene's given path (the paper's case study);
    # "path_speed": lateral profiles too.
    mode: str = "speed"
    # s, ends of the cruise quartics
    cruise_times: tuple[float, ...] = (2.0, 3.0, 4.0, 6.0, 8.0)
    # 1, end speeds as signed shares of the reachable range, dense near v0
    cruise_levels: tuple[float, ...] = (-1.0, -0.6, -0.3, -0.12, 0.0, 0.12, 0.3, 0.6)
    # s, times at which obstacles' edges are followed or overtaken
    edge_times: tuple[float, ...] = (4.0, 8.0)
    # s, headways kept behind a followed obstacle
    follow_headways: tuple[float, ...] = (0.4, 0.8, 1.3, 2.0)
    # number of obstacles followed, nearest first
    num_followed: int = 2
    # m, bumper gap kept to a followed obstacle at standstill
    standstill_gap: float = 2.0
    # m, clearance ahead of an overtaken obstacle (Apollo: 5 m)
    overtake_gap: float = 5.0
    # s, durations of stops at a line
    stop_times: tuple[float, ...] = (3.0, 5.0, 8.0)
    # m, front bumper before the line when standing
    stop_gaps: tuple[float, ...] = (0.5, 2.5)
    # m/s^2, mean braking of stops without a line
    stop_brakings: tuple[float, ...] = (0.8, 1.5, 2.5)
    # drives up to the speed envelope: share of it (1), acceleration, braking
    # and, in bends, lateral acceleration in m/s^2
    envelopes: tuple[tuple[float, float, float, float], ...] = (
        (0.985, 2.0, 0.9, 3.0),
        (0.965, 1.3, 0.8, 2.5),
        (0.9, 0.8, 0.6, 1.8),
    )
    # m/s^3, how fast their acceleration changes
    envelope_jerk: float = 3.0
    # m/s^2, emergency stops, always offered
    emergency_brakings: tuple[float, ...] = (4.0, 6.0, 8.0)
    # number of random two-phase profiles
    num_random: int = 48
    # m/s^2, mean accelerations that bound the reachable end speeds
    reach_braking: float = 3.0
    reach_acceleration: float = 2.0
    # 1, end speeds are capped at this multiple of the limit at the ego
    limit_factor: float = 1.2
    # s, durations from which lateral moves are drawn (times v0 = length)
    lateral_times: tuple[float, ...] = (3.0, 5.0)
    # m, shortest lateral move
    min_lateral_length: float = 15.0
    # m, offsets of nudges from the lateral position at t = 0
    nudge_offsets: tuple[float, ...] = (-0.8, -0.4, 0.4, 0.8)
    # every n-th speed profile is paired with each further lateral profile
    lateral_stride: int = 4
    # m/s^2, feasible accelerations (Apollo: -6 to 4)
    min_acceleration: float = -6.0
    max_acceleration: float = 4.0
    # m/s^3, feasible |jerk| on the 0.47 s grid
    max_jerk: float = 12.0
    # 1/m (Apollo)
    max_curvature: float = 0.1979
    # m/s^2 (Apollo's 4, with room for the noise of recorded paths)
    max_lateral_acceleration: float = 6.0

    def __post_init__(self) -> None:
        """Reject an unknown mode."""
        if self.mode not in MODES:
            raise InputError(f"mode: {self.mode}: expected one of {MODES}")
