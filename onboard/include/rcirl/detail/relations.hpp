// Where each obstacle stands relative to 32 candidates at one time; see
// `rcirl_jax/features/columns.py` and docs/features.md for the classes.
//
//   gap         = max(s_lower - (s + L/2), (s - L/2) - s_upper)
//   lateral gap = max(l_lower - (l + W/2), (l - W/2) - l_upper)
//
// Boxes grow by the ego's half extents, so that the ego becomes a point.
#ifndef RCIRL_DETAIL_RELATIONS_HPP_
#define RCIRL_DETAIL_RELATIONS_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "rcirl/detail/motion.hpp"

namespace rcirl::detail {

constexpr float kLateralBufferM = 0.2f;  // m below which an obstacle is in the way
constexpr float kNudgeRangeM = 3.0f;     // m beyond which it is ignored
constexpr float kObstacleCapM = 100.0f;  // m, "none" of bodies
constexpr float kLineCapM = 60.0f;       // m, "none" of lines and of nudge
constexpr float kLateralCapM = 10.0f;    // m, lateral "none"
constexpr float kMinCollisionM = -10.0f; // m, deepest penetration told apart
constexpr float kFarM = 1e6f;            // m, "no such obstacle"

// The nearest member of a class so far.
struct Nearest {
  Lanes key, speed;

  void clear() {
    std::fill(key.at, key.at + kLanes, kFarM);
    std::fill(speed.at, speed.at + kLanes, 0.0f);
  }

  // An obstacle with these keys, kFarM where it is no member. Of two at the very same key
  // the slower counts: order does not matter.
  void meet(const Lanes& keys, float its_speed) {
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float best = key.at[k], offered = keys.at[k], now = speed.at[k];
      const float slower = its_speed < now ? its_speed : now;
      const float tied = offered <= best ? slower : now;
      speed.at[k] = offered < best ? its_speed : tied;
      key.at[k] = offered < best ? offered : best;
    }
  }
};

// By value: GCC makes no vectors of `std::max`, which picks an address.
inline float larger(float one, float other) { return one < other ? other : one; }

inline Lanes larger(const Lanes& one, const Lanes& other) {
  Lanes most;
  for (std::size_t k = 0; k < kLanes; ++k) most.at[k] = larger(one.at[k], other.at[k]);
  return most;
}

struct Relations {
  Nearest follow;    // in the way and ahead
  Nearest overtake;  // in the way and behind
  Nearest nudge;     // beside, abreast
  Nearest front;     // beside, ahead
  Nearest rear;      // beside, behind
  Nearest stop;      // a line ahead that demands a stop
  Nearest goal;      // the destination ahead
  Lanes signed_square;  // of the closest body: m^2 outside, minus the depth in m inside
  Lanes overrun;        // m, how far a demanding line was just crossed
};

// One comparison in each step: GCC turns loops with more into branches, not vectors. A key
// of kFarM means no member, so that of two conditions the larger key holds.
inline void meet_body(const Ego& ego, const Obstacle& box, std::size_t t, const Point& x,
                      Relations* found) {
  const float lower = box.s_lower[t] - 0.5f * ego.length;
  const float upper = box.s_upper[t] + 0.5f * ego.length;
  const float right = box.l_lower[t] - 0.5f * ego.width;
  const float left = box.l_upper[t] + 0.5f * ego.width;
  Lanes aside, gap, depth, square, ahead, behind, abreast, in_way, in_range, beside;
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float s = x.s.at[k], l = x.l.at[k];
    aside.at[k] = larger(right - l, l - left);
    gap.at[k] = larger(lower - s, s - upper);
    ahead.at[k] = s <= lower ? lower : kFarM;
    behind.at[k] = s >= upper ? -upper : kFarM;
  }
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float across = aside.at[k], along = gap.at[k];
    abreast.at[k] = along < 0.0f ? across : kFarM;
    in_way.at[k] = across < kLateralBufferM ? -kFarM : kFarM;
    in_range.at[k] = across < kNudgeRangeM ? -kFarM : kFarM;
    const float apart = larger(along, 0.0f), off = larger(across, 0.0f);
    square.at[k] = apart * apart + off * off;
    depth.at[k] = larger(along, across);
  }
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float own = depth.at[k] < 0.0f ? depth.at[k] : square.at[k];
    const float closest = found->signed_square.at[k];
    found->signed_square.at[k] = own < closest ? own : closest;
    beside.at[k] = larger(in_range.at[k], -in_way.at[k]);
  }
  const float speed = box.speed[t];
  found->follow.meet(larger(in_way, ahead), speed);
  found->overtake.meet(larger(in_way, behind), speed);
  found->front.meet(larger(beside, ahead), speed);
  found->rear.meet(larger(beside, behind), speed);
  found->nudge.meet(larger(beside, abreast), speed);
}

// A stop line, or the destination. A line counts as overrun at the time where the front
// first lies beyond it while it demands a stop.
inline void meet_line(const Ego& ego, const Obstacle& box, std::size_t t, const Point* x,
                      Relations* found) {
  const bool stops = box.kind == ObstacleKind::kStop;
  const float wall = box.s_lower[t] - 0.5f * ego.length;
  Lanes keys;
  for (std::size_t k = 0; k < kLanes; ++k) keys.at[k] = x[t].s.at[k] <= wall ? wall : kFarM;
  (stops ? found->stop : found->goal).meet(keys, box.speed[t]);
  if (!stops || (t > 0 && box.valid[t - 1] == 0)) return;
  const float wall_before = t > 0 ? box.s_lower[t - 1] - 0.5f * ego.length : kFarM;
  const Lanes& before = x[t > 0 ? t - 1 : 0].s;
  Lanes over;
  for (std::size_t k = 0; k < kLanes; ++k) {
    over.at[k] = before.at[k] <= wall_before ? x[t].s.at[k] - wall : 0.0f;
  }
  for (std::size_t k = 0; k < kLanes; ++k) {
    found->overrun.at[k] = larger(found->overrun.at[k], over.at[k]);
  }
}

// Points [T] against all obstacles, at time t.
inline void relate(const Scene& scene, const Point* x, std::size_t t, Relations* found) {
  for (Nearest* one : {&found->follow, &found->overtake, &found->nudge, &found->front,
                       &found->rear, &found->stop, &found->goal}) {
    one->clear();
  }
  std::fill(found->signed_square.at, found->signed_square.at + kLanes, kFarM * kFarM);
  std::fill(found->overrun.at, found->overrun.at + kLanes, 0.0f);
  for (const Obstacle& box : scene.obstacles) {
    if (box.kind == ObstacleKind::kNone || box.valid[t] == 0) continue;
    if (box.kind <= ObstacleKind::kStatic) {
      meet_body(scene.ego, box, t, x[t], found);
    } else {
      meet_line(scene.ego, box, t, x, found);
    }
  }
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_RELATIONS_HPP_
