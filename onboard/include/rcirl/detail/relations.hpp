// Where each obstacle stands relative to 32 candidates at one time; see
// `rcirl_jax/features/relations.py` and docs/features.md for the classes.
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
#include <cstdint>

#include "rcirl/detail/motion.hpp"

namespace rcirl::detail {

constexpr float kLateralBufferM = 0.2f;  // m below which an obstacle is in the way
constexpr float kNudgeRangeM = 3.0f;     // m beyond which it is ignored
constexpr float kObstacleCapM = 100.0f;  // m, "none" of bodies
constexpr float kLineCapM = 60.0f;       // m, "none" of lines and of nudge
constexpr float kLateralCapM = 10.0f;    // m, lateral "none"
constexpr float kMinCollisionM = -10.0f; // m, deepest penetration told apart
constexpr float kFarM = 1e6f;            // m, "no such obstacle"

struct alignas(64) Marks {
  std::int32_t at[kLanes];  // 0 or 1; as wide as a float, so that loops become vectors
};

// The nearest member of a class so far.
struct Nearest {
  Lanes key, speed;

  void clear() {
    std::fill(key.at, key.at + kLanes, kFarM);
    std::fill(speed.at, speed.at + kLanes, 0.0f);
  }

  // Of two at the very same key the slower counts: order does not matter.
  void meet(const Marks& member, const Lanes& keys, float its_speed) {
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float offered = member.at[k] ? keys.at[k] : kFarM;
      const bool tie = (offered == key.at[k]) & (its_speed < speed.at[k]);
      const bool wins = (offered < key.at[k]) | tie;
      key.at[k] = offered < key.at[k] ? offered : key.at[k];
      speed.at[k] = wins ? its_speed : speed.at[k];
    }
  }

  void meet(const Marks& member, float one_key, float its_speed) {
    Lanes keys;
    std::fill(keys.at, keys.at + kLanes, one_key);
    meet(member, keys, its_speed);
  }
};

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

inline void meet_body(const Ego& ego, const Obstacle& box, std::size_t t, const Point& x,
                      Relations* found) {
  const float lower = box.s_lower[t] - 0.5f * ego.length;
  const float upper = box.s_upper[t] + 0.5f * ego.length;
  const float right = box.l_lower[t] - 0.5f * ego.width;
  const float left = box.l_upper[t] + 0.5f * ego.width;
  Lanes aside;
  Marks follow, overtake, nudge, front, rear;
  for (std::size_t k = 0; k < kLanes; ++k) {
    aside.at[k] = std::max(right - x.l.at[k], x.l.at[k] - left);
    const float gap = std::max(lower - x.s.at[k], x.s.at[k] - upper);
    const std::int32_t in_way = aside.at[k] < kLateralBufferM;
    const std::int32_t beside = (in_way ^ 1) & (aside.at[k] < kNudgeRangeM);
    const std::int32_t ahead = x.s.at[k] <= lower, behind = x.s.at[k] >= upper;
    follow.at[k] = in_way & ahead;
    overtake.at[k] = in_way & behind;
    front.at[k] = beside & ahead;
    rear.at[k] = beside & behind;
    nudge.at[k] = beside & (gap < 0.0f);
    const float apart = std::max(gap, 0.0f), off = std::max(aside.at[k], 0.0f);
    const float depth = std::max(gap, aside.at[k]);
    const float own = depth < 0.0f ? depth : apart * apart + off * off;
    found->signed_square.at[k] = std::min(found->signed_square.at[k], own);
  }
  const float speed = box.speed[t];
  found->follow.meet(follow, lower, speed);
  found->overtake.meet(overtake, -upper, speed);
  found->front.meet(front, lower, speed);
  found->rear.meet(rear, -upper, speed);
  found->nudge.meet(nudge, aside, speed);
}

// A stop line, or the destination. A line counts as overrun at the time where the front
// first lies beyond it while it demands a stop.
inline void meet_line(const Ego& ego, const Obstacle& box, std::size_t t, const Point* x,
                      Relations* found) {
  const bool stops = box.kind == ObstacleKind::kStop;
  const float wall = box.s_lower[t] - 0.5f * ego.length;
  Marks ahead;
  for (std::size_t k = 0; k < kLanes; ++k) ahead.at[k] = x[t].s.at[k] <= wall;
  (stops ? found->stop : found->goal).meet(ahead, wall, box.speed[t]);
  if (!stops || (t > 0 && box.valid[t - 1] == 0)) return;
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float over = x[t].s.at[k] - wall;
    const bool before = t == 0 || x[t - 1].s.at[k] <= box.s_lower[t - 1] - 0.5f * ego.length;
    const float counted = (over > 0.0f) & before ? over : 0.0f;
    found->overrun.at[k] = std::max(found->overrun.at[k], counted);
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
