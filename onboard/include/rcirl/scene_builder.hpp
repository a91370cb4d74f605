// Planning frames from what a car measures: metres, seconds, radians, Cartesian.
//
//   rcirl::Surroundings now;
//   now.ego = {x, y, heading, speed, acceleration, curvature, length, width};
//   now.line.points = {{0.0, 0.0}, {300.0, 0.0}};  // m, in driving direction
//   now.line.speed_limit = {13.9};                 // m/s
//   rcirl::Scene scene;
//   rcirl::Status status = rcirl::scene_from(now, &scene);
//
// The same scene as Python's `scene_from` within 1e-3, and what the simulator's observer
// makes of the same moment, so that a reward reads what it learned from: the eight most
// relevant bodies with a future, the nearest line that demands a stop, the destination.
// Allocates; about a millisecond. docs/own_planner.md.
#ifndef RCIRL_SCENE_BUILDER_HPP_
#define RCIRL_SCENE_BUILDER_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "rcirl/detail/curve.hpp"
#include "rcirl/detail/predict.hpp"
#include "rcirl/scene.hpp"
#include "rcirl/surroundings.hpp"

namespace rcirl {

namespace detail {

constexpr double kBesideM = 20.0;       // m beside the line beyond which it is not the ego's
constexpr double kViewM = 254.0;        // m, farthest station of a scene
constexpr std::size_t kLongGrid = 328;  // stations that limits look at: 400 m beyond a scene
constexpr double kLineHalfWidthM = 20.0, kLineDepthM = 0.1;  // m, of a wall

// A frame around the ego: everything is taken relative to its place, for the digits.
class Builder {
 public:
  explicit Builder(const Surroundings& now)
      : now_(now), line_(shifted(now.line.points)), s0_(line_.project({0.0, 0.0})[0]) {}

  std::string build(Scene* scene) {
    std::string wrong = ego(&scene->ego);
    if (wrong.empty()) wrong = path(scene);
    if (!wrong.empty()) return wrong;
    scene->num_valid = kTimes;
    scene->obstacles.clear();
    bodies(scene);
    const double front = 0.5 * now_.ego.length, wall = nearest_line(scene->ego);
    double goal = std::numeric_limits<double>::infinity();
    if (!now_.destination.empty()) {
      const double rest = project(now_.destination[0][0], now_.destination[0][1])[0];
      if (rest > 0.0) goal = rest + front;
    }
    add_wall(ObstacleKind::kStop, wall, scene);
    add_wall(ObstacleKind::kVirtual, goal, scene);
    return {};
  }

 private:
  std::vector<XY> shifted(std::vector<XY> points) const {
    for (XY& point : points) point = {point[0] - now_.ego.x, point[1] - now_.ego.y};
    return points;
  }

  // (s, l) of a point, s from the ego on.
  XY project(double x, double y) const {
    const XY at = line_.project({x - now_.ego.x, y - now_.ego.y});
    return {at[0] - s0_, at[1]};
  }

  double tilt(double s, double heading) const {
    const double apart = heading - line_.heading(s0_ + s);
    return std::atan2(std::sin(apart), std::cos(apart));
  }

  std::string ego(Ego* found) const {
    const Car& e = now_.ego;
    const double l = line_.project({0.0, 0.0})[1], ahead = line_.length() - s0_;
    const double need = std::max(8.0 * e.speed, 1.0), angle = tilt(0.0, e.heading);
    if (s0_ < -1e-3) {
      return fault("line begins ahead of the ego, m", -s0_, "a line from behind it on");
    }
    if (std::abs(l) > kBesideM) {
      return fault("ego beside the line, m", l, "the line of the lane that it drives on");
    }
    if (ahead < need) {
      return fault("line ends ahead of the ego, m", ahead, number_text(need) + ", its way in 8 s");
    }
    if (std::abs(angle) > 1.5707964) {
      return fault("ego.heading against the line, rad", angle, "along it, in driving direction");
    }
    const double kappa = line_.kappa(s0_), shrink = std::max(1.0 - kappa * l, 0.1);
    found->s = 0.0f;
    found->l = narrow(l);
    found->dl = narrow(std::tan(std::clamp(angle, -1.2, 1.2)) * shrink);
    found->ddl = narrow(e.curvature - kappa);
    found->v = narrow(e.speed * std::cos(angle) / shrink);
    found->a = narrow(e.acceleration);
    found->length = narrow(e.length);
    found->width = narrow(e.width);
    return {};
  }

  // Posted limit at a station of the line; a point's limit holds from it on.
  double posted(const std::vector<double>& from, double s) const {
    if (now_.line.speed_limit.size() == 1) return now_.line.speed_limit[0];
    const auto next = std::upper_bound(from.begin(), from.end(), s) - from.begin();
    return now_.line.speed_limit[static_cast<std::size_t>(std::max<std::ptrdiff_t>(next - 1, 0))];
  }

  // The line from the ego on, with limits that look ahead: in curves sqrt(2 m/s^2 / kappa),
  // and before a lower one braking with 1 m/s^2. See `rcirl_jax/geometry/limits.py`.
  std::string path(Scene* scene) const {
    std::vector<double> at, offsets, from;
    for (const XY& point : now_.path) {
      const XY found = project(point[0], point[1]);
      if (!at.empty() && found[0] <= at.back()) return fault("path", found[0], "no turning back");
      at.push_back(found[0]);
      offsets.push_back(found[1]);
    }
    for (const XY& point : now_.line.points) {
      const double s = line_.project({point[0] - now_.ego.x, point[1] - now_.ego.y})[0];
      from.push_back(from.empty() ? s : std::max(s, from.back()));
    }
    std::vector<double> l(kLongGrid, 0.0), limit(kLongGrid), kappa(kLongGrid);
    for (std::size_t p = 0; p < kLongGrid; ++p) {
      const double s = kLineStepM * static_cast<double>(p);
      if (!at.empty()) l[p] = interpolated(at, offsets, s);
      kappa[p] = line_.kappa(s0_ + s);
    }
    const std::vector<double> bend = gradient(gradient(l));
    for (std::size_t p = 0; p < kLongGrid; ++p) {
      const double sharp = std::max(std::abs(kappa[p] + bend[p]), 1e-5);
      const double s = s0_ + kLineStepM * static_cast<double>(p);
      limit[p] = std::min(posted(from, s), std::sqrt(2.0 / sharp));
    }
    for (std::size_t p = 0; p + 1 < kLongGrid; ++p) limit[p] = std::min(limit[p], limit[p + 1]);
    for (std::size_t p = kLongGrid - 1; p-- > 0;) {
      limit[p] = std::min(limit[p], std::sqrt(limit[p + 1] * limit[p + 1] + 2.0 * kLineStepM));
    }
    const double lane = 0.5 * now_.line.lane_width;
    const double left = now_.line.road_left < 0.0 ? lane : now_.line.road_left;
    const double right = now_.line.road_right < 0.0 ? lane : now_.line.road_right;
    scene->path.road_left.fill(narrow(left));
    scene->path.road_right.fill(narrow(-right));
    for (std::size_t p = 0; p < kStations; ++p) {
      scene->path.kappa[p] = narrow(kappa[p]);
      scene->path.l[p] = narrow(l[p]);
      scene->path.speed_limit[p] = narrow(limit[p]);
    }
    return {};
  }

  // Differences over both neighbours, one-sided at the ends.
  static std::vector<double> gradient(const std::vector<double>& x) {
    std::vector<double> slope(x.size());
    for (std::size_t i = 0; i < x.size(); ++i) {
      const std::size_t low = i > 0 ? i - 1 : 0, high = std::min(i + 1, x.size() - 1);
      slope[i] = (x[high] - x[low]) / (kLineStepM * static_cast<double>(high - low));
    }
    return slope;
  }

  Body body(std::size_t n) const {
    const Other& o = now_.others[n];
    const XY at = project(o.x, o.y);
    const double angle = tilt(at[0], o.heading);
    Body made;
    made.s = at[0];
    made.l = at[1];
    made.speed = o.speed * std::cos(angle);
    made.l_dot = o.speed * std::sin(angle);
    made.a = o.acceleration * std::cos(angle);
    extents(o, angle, &made.half_s, &made.half_l);
    made.kind = o.kind;
    made.given = n;
    return made;
  }

  static void extents(const Other& o, double angle, double* along, double* across) {
    const double c = std::abs(std::cos(angle)), s = std::abs(std::sin(angle));
    *along = 0.5 * (o.length * c + o.width * s);
    *across = 0.5 * (o.length * s + o.width * c);
  }

  void bodies(Scene* scene) const {
    std::vector<Body> near;
    for (std::size_t n = 0; n < now_.others.size(); ++n) {
      near.push_back(body(n));
      predict_offsets(now_.line.lane_width, &near.back());
      near.back().distance = near.back().relevance(*scene);
    }
    std::stable_sort(near.begin(), near.end(), [](const Body& one, const Body& other) {
      return one.distance < other.distance;
    });
    near.resize(std::min(near.size(), kMostBodies));
    predict(scene->ego, static_cast<double>(scene->path.speed_limit[0]), &near);
    for (const Body& one : near) {
      const bool given = !now_.others[one.given].prediction.empty();
      scene->obstacles.push_back(given ? as_given(one) : as_predicted(one));
    }
  }

  static void put(Obstacle* box, std::size_t t, double s, double l, double half_s, double half_l,
                  double speed) {
    box->s_lower[t] = narrow(s - half_s);
    box->s_upper[t] = narrow(s + half_s);
    box->l_lower[t] = narrow(l - half_l);
    box->l_upper[t] = narrow(l + half_l);
    box->speed[t] = narrow(speed);
    box->valid[t] = 1;
  }

  static Obstacle as_predicted(const Body& one) {
    Obstacle box;
    box.kind = one.kind;
    for (std::size_t t = 0; t < kTimes; ++t) {
      put(&box, t, one.future_s[t], one.future_l[t], one.half_s, one.half_l, one.future_speed[t]);
    }
    return box;
  }

  // The future that came with a body, at the T times until its end.
  Obstacle as_given(const Body& one) const {
    const Other& o = now_.others[one.given];
    std::vector<double> time, s, l, angle, rate;
    for (const Pose& pose : o.prediction) {
      const XY at = project(pose.x, pose.y);
      const double turn = tilt(at[0], pose.heading);
      time.push_back(pose.t);
      s.push_back(at[0]);
      l.push_back(at[1]);
      angle.push_back(angle.empty()
                          ? turn
                          : angle.back() + std::remainder(turn - angle.back(), 6.283185307179586));
    }
    for (std::size_t i = 0; i < time.size(); ++i) rate.push_back(slope_at(time, s, i, one.speed));
    Obstacle box;
    box.kind = one.kind;
    for (std::size_t t = 0; t < kTimes; ++t) {
      const double at = kStep * static_cast<double>(t);
      if (at > time.back() + 1e-6) break;
      double half_s, half_l;
      extents(o, interpolated(time, angle, at), &half_s, &half_l);
      put(&box, t, interpolated(time, s, at), interpolated(time, l, at), half_s, half_l,
          interpolated(time, rate, at));
    }
    return box;
  }

  // Derivative of x by uneven times, second order inside.
  static double slope_at(const std::vector<double>& time, const std::vector<double>& x,
                         std::size_t i, double alone) {
    if (time.size() == 1) return alone;
    const auto step = [&](std::size_t k) { return (x[k + 1] - x[k]) / (time[k + 1] - time[k]); };
    if (i == 0) return step(0);
    if (i + 1 == time.size()) return step(i - 1);
    const double before = time[i] - time[i - 1], after = time[i + 1] - time[i];
    return (after * step(i - 1) + before * step(i)) / (before + after);
  }

  // The nearest line ahead of the front that demands a stop; infinity if there is none.
  // Yellow does where the ego can still stop with 3 m/s^2, as in the simulator.
  double nearest_line(const Ego& ego) const {
    double nearest = std::numeric_limits<double>::infinity();
    for (const Signal& signal : now_.signals) {
      const double s = project(signal.x, signal.y)[0], way = s - 0.5 * now_.ego.length;
      const double v = static_cast<double>(ego.v);
      const bool stops = signal.state == SignalState::kYellow && v * v <= 6.0 * way;
      const bool always =
          signal.state == SignalState::kRed || signal.state == SignalState::kStopSign;
      if (way >= 0.0 && (always || stops)) nearest = std::min(nearest, s);
    }
    return nearest;
  }

  static void add_wall(ObstacleKind kind, double s, Scene* scene) {
    if (!(s < kViewM)) return;
    Obstacle box;
    box.kind = kind;
    for (std::size_t t = 0; t < kTimes; ++t) {
      put(&box, t, s + 0.5 * kLineDepthM, 0.0, 0.5 * kLineDepthM, kLineHalfWidthM, 0.0);
    }
    scene->obstacles.push_back(box);
  }

  const Surroundings& now_;
  Line line_;
  double s0_;
};

}  // namespace detail

// The planning frame of one moment, or one line "scene_from: field: value: expected ...".
// A failure leaves `scene` as it was.
inline Status scene_from(const Surroundings& now, Scene* scene) {
  std::string wrong = detail::wrong_input(now);
  if (!wrong.empty()) return Status(wrong);
  Scene made;
  wrong = detail::Builder(now).build(&made);
  if (!wrong.empty()) return Status(wrong);
  const Status usable = check(made);
  if (usable.ok()) *scene = std::move(made);
  return usable;
}

}  // namespace rcirl

#endif  // RCIRL_SCENE_BUILDER_HPP_
