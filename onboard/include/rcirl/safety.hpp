// The safety filter: which candidates a score may choose from, and why not the others.
//
//   std::vector<rcirl::Ruling> rulings(count);
//   rcirl::admit(scene, {s, l, count}, {}, rulings.data());   // [K, T] -> [K]
//   rulings[k].admissible()
//   rcirl::text(rulings[k])                                   // "hits obstacles[0] after 3.29 s"
//
// The rules are those of `rcirl_jax/planner/safety.py`, with which the simulator and the gate
// drive: swept boxes, lines that demand a stop, the speed limit, the road's edges, lateral
// acceleration, the distance to a leader (RSS) and, with `entry`, the gaps in a lane that is
// entered. Nothing here knows what the vehicle can
// drive: `Candidates::feasible` says that. Nothing but `text` allocates, throws or locks.
#ifndef RCIRL_SAFETY_HPP_
#define RCIRL_SAFETY_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <string>

#include "rcirl/detail/text.hpp"
#include "rcirl/features.hpp"
#include "rcirl/scene.hpp"

namespace rcirl {

// Margins and limits of the filter.
struct SafetyLimits {
  bool collisions_only = false;    // only bodies and lines; all else is the reward's to decide
  float margin_along = 0.6f;       // m added along the road on each side of an obstacle
  float margin_growth = 0.3f;      // m/s by which that grows for bodies that move
  float margin_across = 0.25f;     // m added across
  float line_margin = 0.2f;        // m of front bumper kept before a line
  float speed_slack = 0.05f;       // m/s above the planner's speed limit
  float speed_recovery = 0.8f;     // m/s^2, how fast an excess of speed must at least shrink
  float max_lateral_acceleration = 4.0f;  // m/s^2
  float reaction = 0.4f;           // s, actuator lag and one planning period
  float ego_braking = 7.0f;        // m/s^2, braking the ego can rely on
  float leader_braking = 8.0f;     // m/s^2, the hardest braking a leader may show
  float standstill = 1.0f;         // m kept at standstill behind a leader
  std::size_t rss_index = 2;       // of the time at which the distance is judged, below T
  float rss_recovery = 0.3f;       // m by which a violated distance must have grown by then
  // Where paths are planned, as `SafetyConfig(entry=True)`: whether bodies that the ego itself
  // moves in ahead of or behind keep a gap, and before what never moves there is room.
  bool entry = false;
  float rear_reaction = 0.6f;      // s, of who is behind then
  float rear_braking = 3.0f;       // m/s^2
  float room = 8.0f;               // m before what never moves, to get round it
};

// The rules, in the order in which a ruling names them.
enum class Reason : std::uint8_t {
  kNone,         // admissible
  kNotFeasible,  // so the planner said
  kBody,         // touches a body
  kLine,         // passes a line that demands a stop
  kSpeed,        // over the speed limit
  kRoad,         // a side of the box leaves the road
  kBend,         // lateral acceleration
  kDistance,     // too near behind a leader
  kEntry,        // moves in too near ahead of a body or behind one
  // no rules of the filter, but of its input
  kNoNumber,     // a position that is not finite, or a scene that `check` refuses
  kNoRoad,       // offsets l, in a scene without the road's edges
};

// The first rule that a candidate breaks: within a rule the earliest time, at one time the
// first obstacle.
struct Ruling {
  static constexpr std::size_t kNobody = std::numeric_limits<std::size_t>::max();

  Reason reason = Reason::kNoNumber;
  std::size_t obstacle = kNobody;  // its place in the scene
  float time = std::numeric_limits<float>::infinity();  // s; infinite: at no one time

  bool admissible() const { return reason == Reason::kNone; }
};

// A ruling as one line; empty if admissible.
inline std::string text(const Ruling& ruling) {
  char time[32];
  std::snprintf(time, sizeof time, "%.2f s", static_cast<double>(ruling.time));
  const std::string at = std::string(" at ") + time;
  const std::string who = detail::index_text("obstacles", ruling.obstacle);
  switch (ruling.reason) {
    case Reason::kNone: return "";
    case Reason::kNotFeasible: return "is not feasible";
    case Reason::kBody: return "hits " + who + " after " + time;
    case Reason::kLine: return "passes the line " + who + at;
    case Reason::kSpeed: return "is over the speed limit" + at;
    case Reason::kRoad: return "leaves the road" + at;
    case Reason::kBend: return "has too much lateral acceleration" + at;
    case Reason::kDistance: return "is too near behind " + who;
    case Reason::kEntry: return "moves in too near to " + who + at;
    case Reason::kNoNumber: return "has a number that is not finite, or its scene has";
    case Reason::kNoRoad: return "has offsets, and the scene no road edges";
  }
  return "";
}

namespace detail {

constexpr float kMovingMps = 1.0f;    // m/s, above which a body's prediction is uncertain
constexpr float kCrossingMps = 1.0f;  // m/s, sideways speed above which a body is no leader
constexpr float kFreeM = 1e3f;        // m, the margin to a leader where there is none
constexpr float kRoundingM = 1e-2f;   // m, more than rounding errors are at a kilometre
constexpr float kNearerM = 0.2f;      // m by which one comes nearer in earnest
constexpr float kSameEdgeM = 0.01f;   // m by which a box may be further out than it is now
constexpr float kNever = 1e9f;        // the key of a rule that is not broken

inline float time_s(std::size_t t) {
  return static_cast<float>(8.0 / 17.0 * static_cast<double>(t));
}

// Where a rule is broken first: by the smallest key, and of which obstacle.
struct First {
  Lanes key, who;

  First() {
    std::fill(key.at, key.at + kLanes, kNever);
    std::fill(who.at, who.at + kLanes, 0.0f);
  }

  // An obstacle with these keys, kNever where it breaks nothing.
  void meet(const Lanes& keys, std::size_t obstacle) {
    const float number = static_cast<float>(obstacle);
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float offered = keys.at[k], best = key.at[k], before = who.at[k];
      who.at[k] = offered < best ? number : before;
      key.at[k] = offered < best ? offered : best;
    }
  }
};

// The smallest and the largest of a block.
struct Span {
  float low = 0.0f, high = 0.0f;
};

inline Span span(const Lanes& x) {
  Span found = {x.at[0], x.at[0]};
  for (std::size_t k = 1; k < kLanes; ++k) {
    found.low = x.at[k] < found.low ? x.at[k] : found.low;
    found.high = x.at[k] > found.high ? x.at[k] : found.high;
  }
  return found;
}

// The ego's boxes of a block: half extents along and across, and what all of them cover.
struct Boxes {
  Lanes along[kTimes], across[kTimes];
  Span s[kTimes], l[kTimes];
  float most_along[kTimes], most_across[kTimes];

  Boxes(const Ego& ego, const Point* x) {
    for (std::size_t t = 0; t < kTimes; ++t) {
      for (std::size_t k = 0; k < kLanes; ++k) {
        const float slope = x[t].dl.at[k];  // the tangent of the box's tilt
        const float cosine = 1.0f / std::sqrt(1.0f + slope * slope);
        const float sine = std::abs(slope) * cosine;
        along[t].at[k] = 0.5f * (ego.length * cosine + ego.width * sine);
        across[t].at[k] = 0.5f * (ego.length * sine + ego.width * cosine);
      }
      s[t] = span(x[t].s);
      l[t] = span(x[t].l);
      most_along[t] = span(along[t]).high;
      most_across[t] = span(across[t]).high;
    }
  }
};

// A body's box at one time: middle and half extents.
struct Middle {
  float s, l, half_s, half_l;
};

inline Middle middle(const Obstacle& box, std::size_t t) {
  return {0.5f * (box.s_upper[t] + box.s_lower[t]), 0.5f * (box.l_upper[t] + box.l_lower[t]),
          0.5f * (box.s_upper[t] - box.s_lower[t]), 0.5f * (box.l_upper[t] - box.l_lower[t])};
}

inline bool is_body(const Obstacle& box) {
  return box.kind >= ObstacleKind::kVehicle && box.kind <= ObstacleKind::kStatic;
}

// Whether what moves between two places stays further than `reach` from all of a block.
inline bool clear(float from, float to, float reach, const Span& one, const Span& other) {
  const float low = std::min(one.low, other.low), high = std::max(one.high, other.high);
  const float wide = reach + kRoundingM;
  return std::min(from, to) - wide > high || std::max(from, to) + wide < low;
}

// One interval, from time t on, of one body. Between two times the centres' distance runs on
// a straight segment with middle m and half extent h; the boxes, added up to half sides e,
// touch it if and only if no axis separates them. `excused` is over 0 where that counts not.
inline void meet_interval(const Middle& from, const Middle& to, std::size_t obstacle,
                          std::size_t t, float grown, const SafetyLimits& limits,
                          const Boxes& ego, const Point* x, const Lanes& excused, First* first) {
  const float longer = std::max(from.half_s, to.half_s);
  const float wider = std::max(from.half_l, to.half_l);
  const std::size_t u = t + 1;
  const float reach_s = std::max(ego.most_along[t], ego.most_along[u]) + limits.margin_along;
  const float reach_l = std::max(ego.most_across[t], ego.most_across[u]) + limits.margin_across;
  if (clear(from.s, to.s, reach_s + grown + longer, ego.s[t], ego.s[u]) ||
      clear(from.l, to.l, reach_l + wider, ego.l[t], ego.l[u])) {
    return;
  }
  const float along = limits.margin_along, across = limits.margin_across;
  Lanes apart, keys;
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float s0 = from.s - x[t].s.at[k], s1 = to.s - x[u].s.at[k];
    const float l0 = from.l - x[t].l.at[k], l1 = to.l - x[u].l.at[k];
    const float m_s = 0.5f * (s1 + s0), h_s = std::abs(0.5f * (s1 - s0));
    const float m_l = 0.5f * (l1 + l0), h_l = std::abs(0.5f * (l1 - l0));
    const float e_s = larger(ego.along[t].at[k], ego.along[u].at[k]) + along + grown + longer;
    const float e_l = larger(ego.across[t].at[k], ego.across[u].at[k]) + across + wider;
    const float cross = 0.5f * std::abs(m_s * (l1 - l0) - m_l * (s1 - s0));
    const float by_s = std::abs(m_s) - (e_s + h_s), by_l = std::abs(m_l) - (e_l + h_l);
    const float by_both = cross - (e_s * h_l + e_l * h_s);
    apart.at[k] = larger(larger(by_s, by_l), larger(by_both, excused.at[k]));
  }
  const float at = static_cast<float>(t);
  for (std::size_t k = 0; k < kLanes; ++k) keys.at[k] = apart.at[k] > 0.0f ? kNever : at;
  first->meet(keys, obstacle);
}

// Distance d to keep behind a leader (RSS) that stands after `braked` m:
// d = v rho + v^2 / (2 b_ego) - v_lead^2 / (2 b_lead) + standstill
inline float rss_distance(float v, float braked, const SafetyLimits& limits) {
  const float needed = v * limits.reaction + v * v / (2.0f * limits.ego_braking) - braked;
  return larger(needed, 0.0f) + limits.standstill;
}

inline float braked_by(float lead, const SafetyLimits& limits) {
  return lead * lead / (2.0f * limits.leader_braking);
}

// Where the ego enters a body's corridor: its box comes beside or before one that it would be
// clear of at its offset of t = 0. Flags are 1 or 0.
struct Entries {
  Lanes in[kTimes];       // it is in
  Lanes behind, ahead;    // it has entered before the body, or behind it
  Lanes crowds;           // the first time at which one of the two came too near; kNever
};

// How far a body is beside an offset; below 0: in its way.
inline float beside(const Obstacle& box, std::size_t t, float l) {
  return larger(box.l_lower[t] - l, l - box.l_upper[t]);
}

inline Entries entries(const Ego& ego, const Obstacle& box, const SafetyLimits& limits,
                       const Point* x) {
  Entries found;
  const float reach = 0.5f * ego.width + limits.margin_across, half = 0.5f * ego.length;
  for (std::size_t k = 0; k < kLanes; ++k) {
    found.in[0].at[k] = found.behind.at[k] = found.ahead.at[k] = 0.0f;
    found.crowds.at[k] = kNever;
  }
  for (std::size_t t = 1; t < kTimes; ++t) {
    if (box.valid[t] == 0) {
      std::fill(found.in[t].at, found.in[t].at + kLanes, 0.0f);
      continue;
    }
    const float at = static_cast<float>(t), speed = box.speed[t];
    const float lead = braked_by(larger(speed, 0.0f), limits);
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float s = x[t].s.at[k], v = x[t].v.at[k];
      const bool in = beside(box, t, x[t].l.at[k]) < reach && beside(box, t, x[0].l.at[k]) >= reach;
      const bool enters = in && found.in[t - 1].at[k] < 0.5f;
      const bool ahead = 0.5f * (box.s_lower[t] + box.s_upper[t]) > s;
      found.in[t].at[k] = in ? 1.0f : 0.0f;
      if (!enters) continue;
      (ahead ? found.ahead : found.behind).at[k] = 1.0f;
      const float brakes = larger(speed * speed - v * v, 0.0f) / (2.0f * limits.rear_braking);
      const float needs = speed > 0.0f ? speed * limits.rear_reaction + brakes : 0.0f;
      const bool near = ahead ? box.s_lower[t] - s - half < rss_distance(v, lead, limits)
                              : s - half - box.s_upper[t] < needs + limits.standstill;
      if (near) found.crowds.at[k] = std::min(found.crowds.at[k], at);
    }
  }
  return found;
}

// The gaps in corridors that the ego enters, and room before what never moves at the end.
inline void meet_entry(const Ego& ego, const Obstacle& box, std::size_t obstacle,
                       const SafetyLimits& limits, const Point* x, const Entries& entered,
                       First* first) {
  Lanes keys = entered.crowds;
  const std::size_t end = kTimes - 1;
  if (box.kind == ObstacleKind::kStatic && box.valid[0] != 0 && box.valid[end] != 0) {
    const float reach = 0.5f * ego.width + limits.margin_across, half = 0.5f * ego.length;
    const float middle_s = 0.5f * (box.s_lower[end] + box.s_upper[end]);
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float now = box.s_lower[0] - x[0].s.at[k] - half;
      const float before = box.s_lower[end] - x[end].s.at[k] - half;
      const bool in_way = beside(box, end, x[end].l.at[k]) < reach && middle_s > x[end].s.at[k];
      const bool stuck = in_way && before < limits.room && before < now - kNearerM;
      if (stuck) keys.at[k] = std::min(keys.at[k], static_cast<float>(end));
    }
  }
  first->meet(keys, obstacle);
}

// All intervals of one body. One that comes from behind, in the ego's corridor when it is
// first there, does not count; nor does a car or cyclist that the ego has moved in ahead of.
inline void meet_body(const Obstacle& box, std::size_t obstacle, const SafetyLimits& limits,
                      const Boxes& ego, const Point* x, const Entries* entered, First* first) {
  std::size_t begin = 0;
  while (begin < kTimes && box.valid[begin] == 0) ++begin;
  if (begin + 1 >= kTimes) return;
  Middle from = middle(box, begin);
  Lanes excused;
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float away = std::abs(from.l - x[begin].l.at[k]);
    const float in_way = away < from.half_l + ego.across[begin].at[k] ? 1.0f : -kFarM;
    excused.at[k] = from.s - x[begin].s.at[k] < 0.0f ? in_way : -kFarM;
  }
  const bool moves = box.kind != ObstacleKind::kStatic && std::abs(box.speed[begin]) > kMovingMps;
  for (std::size_t t = begin; t + 1 < kTimes; ++t) {
    const bool known = box.valid[t] != 0 && box.valid[t + 1] != 0;
    const Middle to = box.valid[t + 1] != 0 ? middle(box, t + 1) : from;
    const float grown = moves ? limits.margin_growth * time_s(t) : 0.0f;
    Lanes brakes = excused;
    if (entered != nullptr && box.kind <= ObstacleKind::kCyclist) {
      for (std::size_t k = 0; k < kLanes; ++k) {
        const bool follows = entered->behind.at[k] > entered->ahead.at[k];
        if (follows && entered->in[t].at[k] > 0.0f) brakes.at[k] = 1.0f;
      }
    }
    if (known) meet_interval(from, to, obstacle, t, grown, limits, ego, x, brakes, first);
    from = to;
  }
}

// A line that demands a stop is a wall for the front bumper; one behind it now is none.
inline void meet_wall(const Ego& ego, const Obstacle& box, std::size_t obstacle,
                      const SafetyLimits& limits, const Point* x, First* first) {
  for (std::size_t t = 0; t < kTimes; ++t) {
    if (box.valid[t] == 0) continue;
    const float wall = box.s_lower[t], at = static_cast<float>(t);
    Lanes keys;
    for (std::size_t k = 0; k < kLanes; ++k) {
      const float left = wall - (x[0].s.at[k] + 0.5f * ego.length);
      const float front = x[t].s.at[k] + 0.5f * ego.length;
      // nearer than twice the margin, half of the way that is left
      const float halved = 0.5f * left;
      const float slack = halved < limits.line_margin ? halved : limits.line_margin;
      const float passed = front > wall - slack ? at : kNever;
      keys.at[k] = left >= 0.0f ? passed : kNever;
    }
    first->meet(keys, obstacle);
  }
}

// Speed limit, road edges and lateral acceleration at all later times.
inline void meet_limits(const Ego& ego, const SafetyLimits& limits, const Point* x, First* speed,
                        First* road, First* bend) {
  const float half_width = 0.5f * ego.width;
  const auto outside = [&](const Point& p, std::size_t k) {
    const float l = p.l.at[k];
    return larger(l + half_width - p.road_left.at[k], p.road_right.at[k] - (l - half_width));
  };
  for (std::size_t t = 1; t < kTimes; ++t) {
    const float at = static_cast<float>(t), recovered = ego.v - limits.speed_recovery * time_s(t);
    Lanes fast, off, sharp;
    for (std::size_t k = 0; k < kLanes; ++k) {
      // the lower limit of an interval's two ends holds for all of it
      const float now = x[t].speed_limit.at[k], before = x[t - 1].speed_limit.at[k];
      const float allowed = larger((now < before ? now : before) + limits.speed_slack, recovered);
      fast.at[k] = x[t].v.at[k] <= allowed ? kNever : at;
      const float force = std::abs(x[t].v.at[k] * x[t].v.at[k] * x[t].kappa.at[k]);
      sharp.at[k] = force <= limits.max_lateral_acceleration ? kNever : at;
      const float bound = larger(0.0f, outside(x[0], k) + kSameEdgeM);
      off.at[k] = outside(x[t], k) <= bound ? kNever : at;
    }
    speed->meet(fast, 0);
    road->meet(off, 0);
    bend->meet(sharp, 0);
  }
}

// Margin [m] of a block to the RSS distance behind a body at time t.
inline Lanes margin(const Ego& ego, const Obstacle& box, const SafetyLimits& limits,
                    const Point& x, std::size_t t) {
  Lanes found;
  std::fill(found.at, found.at + kLanes, kFreeM);
  if (box.valid[t] == 0) return found;
  const float braked = braked_by(larger(box.speed[t], 0.0f), limits);
  const float corridor = 0.5f * ego.width + limits.margin_across;
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float v = x.v.at[k], s = x.s.at[k], l = x.l.at[k];
    const float gap = box.s_lower[t] - s - 0.5f * ego.length;
    const float kept = gap - rss_distance(v, braked, limits);
    const float in_way = beside(box, t, l) < corridor ? kept : kFreeM;
    found.at[k] = box.s_upper[t] > s ? in_way : kFreeM;
  }
  return found;
}

// The distance to a leader, kept or growing; the key is the margin.
inline void meet_leader(const Ego& ego, const Obstacle& box, std::size_t obstacle,
                        const SafetyLimits& limits, const Point* x, First* first) {
  const bool seen = box.valid[0] != 0 && box.valid[1] != 0;
  if (seen && !(std::abs(box.l_lower[1] - box.l_lower[0]) / kDt < kCrossingMps)) return;
  const std::size_t later = std::min(limits.rss_index, kTimes - 1);
  const Lanes now = margin(ego, box, limits, x[0], 0);
  const Lanes soon = margin(ego, box, limits, x[later], later);
  Lanes keys;
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float grown = now.at[k] + limits.rss_recovery;
    const float short_of = soon.at[k] >= grown ? kNever : soon.at[k];
    keys.at[k] = soon.at[k] >= 0.0f ? kNever : short_of;
  }
  first->meet(keys, obstacle);
}

// Rulings on a block of candidates; `feasible` is of its first one, or null.
inline void judge(const Scene& scene, const SafetyLimits& limits, std::size_t lanes,
                  const Point* x, const bool* known, const std::uint8_t* feasible,
                  Ruling* rulings) noexcept {
  const Boxes ego(scene.ego, x);
  First body, line, speed, road, bend, leader, entry;
  const bool enters = limits.entry && !limits.collisions_only;
  for (std::size_t n = 0; n < scene.obstacles.size(); ++n) {
    const Obstacle& box = scene.obstacles[n];
    if (is_body(box) && enters) {
      const Entries entered = entries(scene.ego, box, limits, x);
      meet_body(box, n, limits, ego, x, &entered, &body);
      meet_entry(scene.ego, box, n, limits, x, entered, &entry);
    } else if (is_body(box)) {
      meet_body(box, n, limits, ego, x, nullptr, &body);
    }
    if (box.kind == ObstacleKind::kStop) meet_wall(scene.ego, box, n, limits, x, &line);
    if (is_body(box) && !limits.collisions_only) {
      meet_leader(scene.ego, box, n, limits, x, &leader);
    }
  }
  if (!limits.collisions_only) meet_limits(scene.ego, limits, x, &speed, &road, &bend);
  for (std::size_t k = 0; k < lanes; ++k) {
    Ruling& found = rulings[k] = Ruling();
    const auto broken = [&](Reason reason, const First& rule, bool timed, bool named) {
      if (!(rule.key.at[k] < kNever)) return false;
      found.reason = reason;
      if (timed) found.time = time_s(static_cast<std::size_t>(rule.key.at[k]));
      if (named) found.obstacle = static_cast<std::size_t>(rule.who.at[k]);
      return true;
    };
    if (!known[k]) continue;
    found.reason = Reason::kNone;
    if (feasible != nullptr && feasible[k] == 0) {
      found.reason = Reason::kNotFeasible;
      continue;
    }
    static_cast<void>(broken(Reason::kBody, body, true, true) ||
                      broken(Reason::kLine, line, true, true) ||
                      broken(Reason::kSpeed, speed, true, false) ||
                      broken(Reason::kRoad, road, true, false) ||
                      broken(Reason::kBend, bend, true, false) ||
                      broken(Reason::kDistance, leader, false, true) ||
                      broken(Reason::kEntry, entry, true, true));
  }
}

// Whether the filter can judge candidates at all; else why not.
inline Reason judgeable(const Scene& scene, const Candidates& candidates) {
  if (!usable(scene)) return Reason::kNoNumber;
  return candidates.l != nullptr && !scene.path.has_road() ? Reason::kNoRoad : Reason::kNone;
}

}  // namespace detail

// Rulings [K] on all candidates of a scene; returns how many are admissible.
inline std::size_t admit(const Scene& scene, const Candidates& candidates,
                         const SafetyLimits& limits, Ruling* rulings) noexcept {
  Ruling none;
  none.reason = detail::judgeable(scene, candidates);
  if (!none.admissible()) {
    std::fill(rulings, rulings + candidates.count, none);
    return 0;
  }
  const std::uint8_t* feasible = candidates.feasible;
  detail::for_each_block(
      scene, candidates,
      [&](std::size_t first, std::size_t lanes, const detail::Point* x, const bool* known) {
        const std::uint8_t* may = feasible == nullptr ? nullptr : feasible + first;
        detail::judge(scene, limits, lanes, x, known, may, rulings + first);
      });
  return static_cast<std::size_t>(
      std::count_if(rulings, rulings + candidates.count,
                    [](const Ruling& ruling) { return ruling.admissible(); }));
}

}  // namespace rcirl

#endif  // RCIRL_SAFETY_HPP_
