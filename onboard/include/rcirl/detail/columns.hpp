// The columns of F, named as in `rcirl_jax/features/columns.py`.
#ifndef RCIRL_DETAIL_COLUMNS_HPP_
#define RCIRL_DETAIL_COLUMNS_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "rcirl/detail/relations.hpp"

namespace rcirl::detail {

enum Column : std::size_t {
  kL,
  kDl,
  kDdl,
  kCurvature,
  kStation,
  kTime,
  kVelocity,
  kSpeedLimit,
  kAcceleration,
  kJerk,
  kLateralAcceleration,
  kCollisionDistance,
  kCollision,
  kFollowDistance,
  kFollowSpeed,
  kOvertakeDistance,
  kOvertakeSpeed,
  kStopDistance,
  kStopSpeed,
  kVirtualDistance,
  kVirtualSpeed,
  kNudgeDistance,
  kNudgeLateral,
  kNudgeSpeed,
  kSidepassFrontDistance,
  kSidepassFrontSpeed,
  kSidepassRearDistance,
  kSidepassRearSpeed,
  kNumColumns,
};

struct Named {
  const char* name;
  const char* unit;
};

constexpr Named kColumns[] = {
    {"l", "m"},
    {"dl", "1"},
    {"ddl", "1/m"},
    {"curvature", "1/m"},
    {"station", "m"},
    {"time", "s"},
    {"velocity", "m/s"},
    {"speed_limit", "m/s"},
    {"acceleration", "m/s^2"},
    {"jerk", "m/s^3"},
    {"lateral_acceleration", "m/s^2"},
    {"collision_distance", "m"},
    {"collision", "1"},
    {"follow_distance", "m"},
    {"follow_speed", "m/s"},
    {"overtake_distance", "m"},
    {"overtake_speed", "m/s"},
    {"stop_distance", "m"},
    {"stop_speed", "m/s"},
    {"virtual_distance", "m"},
    {"virtual_speed", "m/s"},
    {"nudge_distance", "m"},
    {"nudge_lateral", "m"},
    {"nudge_speed", "m/s"},
    {"sidepass_front_distance", "m"},
    {"sidepass_front_speed", "m/s"},
    {"sidepass_rear_distance", "m"},
    {"sidepass_rear_speed", "m/s"},
};
static_assert(sizeof kColumns / sizeof kColumns[0] == kNumColumns, "a name for each column");

// Distance and speed minus the ego's: (cap, 0) where none is nearer than the cap. The
// distance is the key plus `sign` times the station.
inline void write_nearest(const Nearest& nearest, float sign, float cap, const Point& x,
                          Lanes* distance, Lanes* speed) {
  Lanes found, relative;
  for (std::size_t k = 0; k < kLanes; ++k) {
    found.at[k] = nearest.key.at[k] + sign * x.s.at[k];
    relative.at[k] = nearest.speed.at[k] - x.v.at[k];
  }
  for (std::size_t k = 0; k < kLanes; ++k) {
    distance->at[k] = found.at[k] < cap ? found.at[k] : cap;
    speed->at[k] = found.at[k] < cap ? relative.at[k] : 0.0f;
  }
}

// Every column of 32 candidates at time t.
inline void fill_columns(const Ego& ego, std::size_t t, const Point& x, const Relations& near,
                         Lanes* out) {
  out[kL] = x.l;
  out[kDl] = x.dl;
  out[kDdl] = x.ddl;
  out[kCurvature] = x.kappa;
  out[kVelocity] = x.v;
  out[kSpeedLimit] = x.speed_limit;
  out[kAcceleration] = x.a;
  out[kJerk] = x.j;
  const float time = static_cast<float>(8.0 / 17.0 * static_cast<double>(t));
  for (std::size_t k = 0; k < kLanes; ++k) {
    out[kStation].at[k] = x.s.at[k] - ego.s;
    out[kTime].at[k] = time;
    out[kLateralAcceleration].at[k] = x.v.at[k] * x.v.at[k] * x.kappa.at[k];
  }
  Lanes apart = near.signed_square;
  for (float& one : apart.at) one = one > 0.0f ? std::sqrt(one) : one;
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float overrun = near.overrun.at[k], over = std::min(apart.at[k], -overrun);
    const float nearer = overrun > 0.0f ? over : apart.at[k];
    const float capped = std::min(std::max(nearer, kMinCollisionM), kObstacleCapM);
    out[kCollisionDistance].at[k] = capped;
    out[kCollision].at[k] = capped < 0.0f ? 1.0f : 0.0f;
  }
  const auto write = [&](const Nearest& nearest, float sign, float cap, Column distance,
                         Column speed) {
    write_nearest(nearest, sign, cap, x, &out[distance], &out[speed]);
  };
  write(near.follow, -1.0f, kObstacleCapM, kFollowDistance, kFollowSpeed);
  write(near.overtake, 1.0f, kObstacleCapM, kOvertakeDistance, kOvertakeSpeed);
  write(near.stop, -1.0f, kLineCapM, kStopDistance, kStopSpeed);
  write(near.goal, -1.0f, kLineCapM, kVirtualDistance, kVirtualSpeed);
  write(near.front, -1.0f, kObstacleCapM, kSidepassFrontDistance, kSidepassFrontSpeed);
  write(near.rear, 1.0f, kObstacleCapM, kSidepassRearDistance, kSidepassRearSpeed);
  write(near.nudge, 0.0f, kLateralCapM, kNudgeLateral, kNudgeSpeed);
  for (std::size_t k = 0; k < kLanes; ++k) {
    const bool abreast = out[kNudgeLateral].at[k] < kLateralCapM;
    out[kNudgeDistance].at[k] = abreast ? 0.0f : kLineCapM;
  }
}

// The positions [K, T] of the candidates from `first` on; the last of `lanes` fills the
// block up. One whose positions are not all finite is not `known`.
inline void fill_block(const float* s, const float* l, std::size_t first, std::size_t lanes,
                       Point* x, bool* known) {
  for (std::size_t k = 0; k < kLanes; ++k) {
    const std::size_t from = (first + std::min(k, lanes - 1)) * kTimes;
    known[k] = true;
    for (std::size_t t = 0; t < kTimes; ++t) {
      x[t].s.at[k] = s[from + t];
      x[t].l.at[k] = l != nullptr ? l[from + t] : 0.0f;
      known[k] &= std::isfinite(x[t].s.at[k]) && std::isfinite(x[t].l.at[k]);
    }
  }
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_COLUMNS_HPP_
