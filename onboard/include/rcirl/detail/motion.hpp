// From positions to derivatives, for 32 candidates side by side; see
// `rcirl_jax/sampling/kinematics.py`, whose order of operations this keeps.
//
//   v_i = (s_{i+1} - s_{i-1}) / 2dt        v_0, a_0: the ego's
//   a_i = (s_{i+1} - 2 s_i + s_{i-1}) / dt^2
//   j_i = (a_i - a_{i-1}) / dt             j_0 = j_1
#ifndef RCIRL_DETAIL_MOTION_HPP_
#define RCIRL_DETAIL_MOTION_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "rcirl/detail/network.hpp"
#include "rcirl/scene.hpp"

namespace rcirl::detail {

constexpr float kDt = static_cast<float>(8.0 / 17.0);                  // s
constexpr float kDtSquared = static_cast<float>(8.0 / 17.0 * 8.0 / 17.0);  // s^2
constexpr float kMinAdvanceM = 1.0f;  // m below which dl/ds is taken as 0
constexpr float kMinShrink = 0.1f;    // 1, least value of 1 - kappa l
constexpr std::size_t kSlopePoints = 3;  // grid points on each side of a slope of the path

// A path with its slopes, point by point, so that one look-up finds all.
struct PathTable {
  // rows of eight, so that a look-up is a few vector instructions
  enum Column { kL, kDl, kDdl, kKappa, kDkappa, kLimit, kRoadLeft, kRoadRight, kColumns };

  float at[kStations][kColumns];
};

// Slope by station over `points` grid points on each side; the ends are held.
inline float table_slope(const Stations& table, std::size_t p, std::size_t points) {
  const std::size_t before = p < points ? 0 : p - points;
  const std::size_t after = std::min(p + points, kStations - 1);
  return (table[after] - table[before]) / (2.0f * static_cast<float>(points) * kStationStepM);
}

inline PathTable tabulated(const Path& path) {
  PathTable table = {};
  Stations dl;
  for (std::size_t p = 0; p < kStations; ++p) dl[p] = table_slope(path.l, p, kSlopePoints);
  for (std::size_t p = 0; p < kStations; ++p) {
    float* row = table.at[p];
    row[PathTable::kL] = path.l[p];
    row[PathTable::kDl] = dl[p];
    row[PathTable::kDdl] = table_slope(dl, p, kSlopePoints);
    row[PathTable::kKappa] = path.kappa[p];
    row[PathTable::kDkappa] = table_slope(path.kappa, p, 1);
    row[PathTable::kLimit] = path.speed_limit[p];
    row[PathTable::kRoadLeft] = path.road_left[p];
    row[PathTable::kRoadRight] = path.road_right[p];
  }
  return table;
}

// 32 candidates at one time, with what the path is there.
struct Point {
  Lanes s, v, a, j;   // m, m/s, m/s^2, m/s^3
  Lanes l, dl, ddl;   // m, 1, 1/m
  Lanes speed_limit;  // m/s, at the station
  Lanes road_left, road_right;  // m, at the station
  Lanes kappa;        // 1/m, of the path driven
};

// Curvature of the path driven, left positive (Werling 2010, app. I).
inline float driven_curvature(float kappa, float dkappa, float l, float dl, float ddl) {
  const float room = 1.0f - kappa * l;
  const float shrink = room < kMinShrink ? kMinShrink : room;
  const float tangent = dl / shrink;
  const float cosine = 1.0f / std::sqrt(1.0f + tangent * tangent);
  const float bend = ddl + (dkappa * l + kappa * dl) * tangent;
  return (bend * (cosine * cosine) / shrink + kappa) * cosine / shrink;
}

// v, a, j from s. At the last valid time there is no next point: a is carried over, and
// v follows from it.
inline void by_time(const Scene& scene, Point* x) {
  for (std::size_t t = 0; t < kTimes; ++t) {
    const bool has_next = t + 1 < scene.num_valid;
    const std::size_t c = has_next || t == 0 ? t : t - 1;  // where a is taken: carried over
    const Lanes &first = x[c > 0 ? c - 1 : 0].s, &middle = x[c].s;
    const Lanes& last = x[std::min(c + 1, kTimes - 1)].s;
    Lanes &v = x[t].v, &a = x[t].a;
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float central = (last.at[k] - 2.0f * middle.at[k] + first.at[k]) / kDtSquared;
      a.at[k] = c == 0 ? scene.ego.a : central;
    }
    const Lanes &s = x[t].s, &ahead = x[std::min(t + 1, kTimes - 1)].s;
    const Lanes& behind = x[t > 0 ? t - 1 : 0].s;
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float central = (ahead.at[k] - behind.at[k]) / (2.0f * kDt);
      const float carried = (s.at[k] - behind.at[k]) / kDt + 0.5f * kDt * a.at[k];
      v.at[k] = t == 0 ? scene.ego.v : has_next ? central : carried;
    }
  }
  for (std::size_t t = 1; t < kTimes; ++t) {
    for (std::size_t k = 0; k < kLanes; ++k) {
      x[t].j.at[k] = (x[t].a.at[k] - x[t - 1].a.at[k]) / kDt;
    }
  }
  x[0].j = x[1].j;
}

// dy/ds over the neighbouring times; 0 where the car advances a metre or less.
inline void by_station(Point* x, Lanes Point::*y, float first, Lanes Point::*slope) {
  for (std::size_t t = 0; t < kTimes; ++t) {
    const Point &ahead = x[std::min(t + 1, kTimes - 1)], &behind = x[t > 0 ? t - 1 : 0];
    Lanes counted, divisor;
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float advance = ahead.s.at[k] - behind.s.at[k];
      const float change = (ahead.*y).at[k] - (behind.*y).at[k];
      counted.at[k] = advance > kMinAdvanceM ? change : 0.0f;
      divisor.at[k] = advance > kMinAdvanceM ? advance : 1.0f;
    }
    Lanes& out = x[t].*slope;
    for (std::size_t k = 0; k < kLanes; ++k) out.at[k] = counted.at[k] / divisor.at[k];
    if (t == 0) std::fill(out.at, out.at + kLanes, first);
  }
}

// The path at the stations, linear between grid points and held at both ends; where the
// candidates drive along it, their l, dl and ddl too.
inline void look_up(const PathTable& table, bool on_path, Point* x, Lanes* kappa,
                    Lanes* dkappa) {
  for (std::size_t k = 0; k < kLanes; ++k) {
    float position = x->s.at[k] / kStationStepM;
    position = position > 0.0f ? position : 0.0f;  // NaN becomes 0
    position = std::min(position, static_cast<float>(kStations - 1));
    const std::size_t low = std::min(static_cast<std::size_t>(position), kStations - 2);
    const float share = position - static_cast<float>(low);
    const float *start = table.at[low], *end = table.at[low + 1];
    float row[PathTable::kColumns];
    for (std::size_t c = 0; c < PathTable::kColumns; ++c) {
      row[c] = start[c] + share * (end[c] - start[c]);
    }
    if (on_path) {
      x->l.at[k] = row[PathTable::kL];
      x->dl.at[k] = row[PathTable::kDl];
      x->ddl.at[k] = row[PathTable::kDdl];
    }
    kappa->at[k] = row[PathTable::kKappa];
    dkappa->at[k] = row[PathTable::kDkappa];
    x->speed_limit.at[k] = row[PathTable::kLimit];
    x->road_left.at[k] = row[PathTable::kRoadLeft];
    x->road_right.at[k] = row[PathTable::kRoadRight];
  }
}

// Everything else of points [T] that hold s and, unless they drive along the path, l.
inline void complete(const Scene& scene, const PathTable& table, bool on_path, Point* x) {
  by_time(scene, x);
  if (!on_path) {
    by_station(x, &Point::l, scene.ego.dl, &Point::dl);
    by_station(x, &Point::dl, scene.ego.ddl, &Point::ddl);
  }
  for (std::size_t t = 0; t < kTimes; ++t) {
    Lanes kappa, dkappa;
    look_up(table, on_path, &x[t], &kappa, &dkappa);
    for (std::size_t k = 0; k < kLanes; ++k) {
      if (t == 0) x[t].dl.at[k] = scene.ego.dl;
      if (t == 0) x[t].ddl.at[k] = scene.ego.ddl;
      x[t].kappa.at[k] = driven_curvature(kappa.at[k], dkappa.at[k], x[t].l.at[k],
                                          x[t].dl.at[k], x[t].ddl.at[k]);
    }
  }
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_MOTION_HPP_
