// What the planner knows of the others' futures; see `rcirl_jax/planner/prediction.py`.
//
//   a(t) = w a_0 + (1 - w) a_IDM(t),   w = exp(-t / 2 s)
//
// Whoever keeps a lane follows the nearest body ahead in it, by the IDM with the headway
// that is kept now; without a leader only the first term acts.
#ifndef RCIRL_DETAIL_PREDICT_HPP_
#define RCIRL_DETAIL_PREDICT_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "rcirl/scene.hpp"

namespace rcirl::detail {

constexpr std::size_t kMostBodies = 8;  // handed to the planner, the most relevant first
constexpr double kStep = 8.0 / 17.0;    // s

// The given path's offset at a station, linear between the stations of the grid.
inline double path_offset(const Path& path, double s) {
  const double place = std::clamp(s / static_cast<double>(kStationStepM), 0.0,
                                  static_cast<double>(kStations - 1));
  const std::size_t low = std::min(static_cast<std::size_t>(place), kStations - 2);
  const double share = place - static_cast<double>(low);
  return (1.0 - share) * static_cast<double>(path.l[low]) +
         share * static_cast<double>(path.l[low + 1]);
}

// One of the others in the scene's frame, with its future.
struct Body {
  double s = 0.0, l = 0.0;            // m
  double speed = 0.0, l_dot = 0.0;    // m/s
  double a = 0.0;                     // m/s^2
  double half_s = 0.0, half_l = 0.0;  // m
  ObstacleKind kind = ObstacleKind::kNone;
  std::size_t given = 0;  // its place among those given

  std::array<double, kTimes> future_s{}, future_l{}, future_speed{};
  bool follows = false;    // a lane; else it keeps its speed
  double headway = 1.5;    // s
  double distance = 0.0;   // m, `relevance`

  // How much it matters, as a distance in m; see `rcirl_jax/geometry/relevance.py`.
  // Both keep their speed; `future_l` is known.
  double relevance(const Scene& scene) const {
    const double reach = half_l + 0.5 * static_cast<double>(scene.ego.width);
    double least = std::numeric_limits<double>::infinity();
    for (std::size_t t = 0; t < kTimes; ++t) {
      const double way = kStep * static_cast<double>(t);
      const double at = s + speed * way - static_cast<double>(scene.ego.s);
      const double apart = at - static_cast<double>(scene.ego.v) * way;
      const double aside = std::abs(future_l[t] - path_offset(scene.path, at)) - reach;
      least = std::min(least, (apart < 0.0 ? -2.0 * apart : apart) + 16.0 * std::max(aside, 0.0));
    }
    return least;
  }
};

// Offsets: a lane keeper that moves sideways ends in the middle of the lane it moves to.
inline void predict_offsets(double lane_width, Body* body) {
  const double width = std::max(lane_width, 1.0);
  const double aside = std::abs(body->l_dot);
  const bool crosses = body->kind == ObstacleKind::kPedestrian ||
                       aside > 0.5 * std::abs(body->speed) + 0.3;
  const double direction = body->l_dot > 0.0 ? 1.0 : body->l_dot < 0.0 ? -1.0 : 0.0;
  const double lane = std::nearbyint(body->l / width + 0.5 * direction);
  const double room = aside > 0.3 ? std::max((width * lane - body->l) * direction, 0.0) : 0.0;
  for (std::size_t t = 0; t < kTimes; ++t) {
    const double way = kStep * static_cast<double>(t);
    body->future_l[t] = crosses ? body->l + body->l_dot * way
                                : body->l + direction * std::min(aside * way, room);
  }
  body->follows = !crosses && body->speed >= 0.0 && body->kind != ObstacleKind::kStatic;
}

// Intelligent Driver Model (Treiber et al. 2000), a = 1 m/s^2, b = 2 m/s^2.
inline double idm(double v, double gap, double lead, double desired, double headway) {
  const double interaction = v * (v - lead) / (2.0 * std::sqrt(2.0));
  const double wanted = 2.0 + std::max(v * headway + interaction, 0.0);
  const double free = std::pow(v / std::max(desired, 0.1), 4.0);
  const double close = wanted / std::max(gap, 0.1);
  return std::clamp(1.0 - free - close * close, -8.0, 1.0);
}

struct Leader {
  double gap = 1e3, speed = 0.0;  // m, m/s
  bool found = false;
};

// The nearest body ahead in the way of another at time t, the ego among them.
inline Leader leader_of(const Body& own, const std::vector<Body>& all, const Ego& ego,
                        std::size_t t) {
  Leader nearest;
  double least = std::numeric_limits<double>::infinity();
  const auto meet = [&](double s, double l, double v, double half_s, double half_l) {
    const double aside = std::abs(l - own.future_l[t]) - half_l;
    if (!(aside < own.half_l + 0.2 && s > own.future_s[t])) return;
    const double gap = s - own.future_s[t] - half_s - own.half_s;
    if (gap < least) {
      least = gap;
      nearest = {gap, v, true};
    }
  };
  for (const Body& o : all) {
    meet(o.future_s[t], o.future_l[t], o.future_speed[t], o.half_s, o.half_l);
  }
  const double v = static_cast<double>(ego.v), way = kStep * static_cast<double>(t);
  meet(static_cast<double>(ego.s) + v * way, static_cast<double>(ego.l), v,
       0.5 * static_cast<double>(ego.length), 0.5 * static_cast<double>(ego.width));
  return nearest;
}

// Stations and speeds of all, whose offsets are known.
inline void predict(const Ego& ego, double limit, std::vector<Body>* bodies) {
  for (Body& body : *bodies) {
    body.future_s[0] = body.s;
    body.future_speed[0] = body.speed;
  }
  for (Body& body : *bodies) {
    const double kept = (leader_of(body, *bodies, ego, 0).gap - 2.0) / std::max(body.speed, 1.0);
    body.headway = std::clamp(kept, 0.4, 1.5);
  }
  for (std::size_t t = 0; t + 1 < kTimes; ++t) {
    const double share = std::exp(-0.5 * kStep * static_cast<double>(t));
    for (Body& body : *bodies) {
      const double v = body.future_speed[t], desired = std::max(body.speed, 0.8 * limit);
      const Leader lead = leader_of(body, *bodies, ego, t);
      double a = share * body.a;
      if (lead.found && (v > 0.2 || lead.speed > 0.5)) {
        a += (1.0 - share) * idm(v, lead.gap, lead.speed, desired, body.headway);
      }
      if (body.a < -2.0) a = std::min(a, body.a);  // hard braking goes on until standing
      const double after = body.follows ? std::max(v + a * kStep, 0.0) : v;
      body.future_s[t + 1] = body.future_s[t] + 0.5 * (v + after) * kStep;
      body.future_speed[t + 1] = after;
    }
  }
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_PREDICT_HPP_
