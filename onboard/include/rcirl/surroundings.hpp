// What a car measures of a moment, in metres, seconds and radians, Cartesian: any one frame,
// headings counter-clockwise from its x axis.
#ifndef RCIRL_SURROUNDINGS_HPP_
#define RCIRL_SURROUNDINGS_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

#include "rcirl/detail/curve.hpp"
#include "rcirl/scene.hpp"

namespace rcirl {

// The ego now; x, y of its box's centre.
struct Car {
  double x = 0.0, y = 0.0;    // m
  double heading = 0.0;       // rad, counter-clockwise from the x axis
  double speed = 0.0;         // m/s, >= 0
  double acceleration = 0.0;  // m/s^2 along its heading
  double curvature = 0.0;     // 1/m, of the way it drives, left positive
  double length = 0.0, width = 0.0;  // m, to be set
};

// The middle of the ego's lane, from behind the ego to as far as it may drive.
struct CentreLine {
  std::vector<detail::XY> points;   // m, in driving direction
  std::vector<double> speed_limit;  // m/s, posted: one, or one for each point, from it on
  double lane_width = 3.6;          // m
  // m from the line to the road's edges, for the safety filter; below 0: those of the lane
  double road_left = -1.0, road_right = -1.0;
};

struct Pose {
  double t = 0.0;           // s from now
  double x = 0.0, y = 0.0;  // m
  double heading = 0.0;     // rad
};

// One of the others now; x, y of its box's centre.
struct Other {
  ObstacleKind kind = ObstacleKind::kVehicle;  // kVehicle to kStatic
  double x = 0.0, y = 0.0;    // m
  double heading = 0.0;       // rad
  double speed = 0.0;         // m/s along its heading
  double acceleration = 0.0;  // m/s^2 along its heading
  double length = 0.0, width = 0.0;  // m, to be set
  // its future, t from 0 on and rising; after the last it is not there. Empty: predicted as
  // in training
  std::vector<Pose> prediction;
};

enum class SignalState { kRed, kStopSign, kYellow, kGreen, kOff };

// A stop line of the ego's lane and what it says now.
struct Signal {
  double x = 0.0, y = 0.0;  // m, where the line crosses the lane
  SignalState state = SignalState::kOff;
};

struct Surroundings {
  Car ego;
  CentreLine line;
  std::vector<Other> others;
  std::vector<Signal> signals;
  std::vector<detail::XY> path;         // m, along which speed is planned; empty: the line
  std::vector<detail::XY> destination;  // m, none or one: where the ego comes to rest
};

namespace detail {

constexpr double kMost = 1e9;  // of any number

inline std::string fault(const std::string& field, double value, const std::string& expected) {
  return "scene_from: " + field + ": " + number_text(value) + ": expected " + expected;
}

// The first number of a list of (name, value) that is not finite or out of range.
inline std::string wrong_number(const std::string& name,
                                const std::vector<std::pair<const char*, double>>& values) {
  for (const auto& [field, value] : values) {
    const std::string place = name + "." + field, key = field;
    if (!(std::abs(value) <= kMost)) return fault(place, value, "a finite number up to 1e9");
    if ((key == "length" || key == "width") && value <= 0.0) return fault(place, value, "over 0 m");
    if (key == "heading" && std::abs(value) > 12.6) {
      return fault(place, value, "radians, not degrees");
    }
  }
  return {};
}

inline std::string wrong_polyline(const std::string& name, const std::vector<XY>& points) {
  double length = 0.0;
  for (std::size_t i = 0; i < points.size(); ++i) {
    const double most = std::max(std::abs(points[i][0]), std::abs(points[i][1]));
    if (!(most <= kMost) || std::isnan(points[i][1])) {
      return fault(index_text(name, i), points[i][0], "finite numbers up to 1e9");
    }
    if (i == 0) continue;
    const double step =
        std::hypot(points[i][0] - points[i - 1][0], points[i][1] - points[i - 1][1]);
    if (step > kSamePlaceM) length += step;
  }
  return length >= 1.0 && length <= 1e5 ? "" : fault(name, length, "a line of 1 m to 100 km");
}

inline std::string wrong_prediction(const std::string& name, const std::vector<Pose>& poses) {
  for (std::size_t i = 0; i < poses.size(); ++i) {
    const Pose& p = poses[i];
    const std::string place = index_text(name + ".prediction", i);
    const std::string wrong =
        wrong_number(place, {{"t", p.t}, {"x", p.x}, {"y", p.y}, {"heading", p.heading}});
    if (!wrong.empty()) return wrong;
    const bool rises = i == 0 ? p.t <= 1e-6 : p.t > poses[i - 1].t;
    if (!rises) return fault(place + ".t", p.t, "from 0 s, rising");
  }
  return {};
}

// What is wrong with some input, or nothing.
inline std::string wrong_input(const Surroundings& now) {
  const Car& e = now.ego;
  std::string wrong = wrong_number("ego", {{"x", e.x}, {"y", e.y}, {"heading", e.heading},
                                           {"speed", e.speed}, {"acceleration", e.acceleration},
                                           {"curvature", e.curvature}, {"length", e.length},
                                           {"width", e.width}});
  if (wrong.empty() && e.speed < 0.0) wrong = fault("ego.speed", e.speed, "0 m/s or more");
  if (wrong.empty()) wrong = wrong_polyline("line.points", now.line.points);
  if (wrong.empty() && !now.path.empty()) wrong = wrong_polyline("path", now.path);
  if (!wrong.empty()) return wrong;
  const std::size_t limits = now.line.speed_limit.size();
  if (limits != 1 && limits != now.line.points.size()) {
    return fault("line.speed_limit", static_cast<double>(limits),
                 "one number, or one for each point");
  }
  for (const double limit : now.line.speed_limit) {
    if (!(limit > 0.0 && std::isfinite(limit))) return fault("line.speed_limit", limit, "over 0");
  }
  if (!(now.line.lane_width > 0.0 && std::isfinite(now.line.lane_width))) {
    return fault("line.lane_width", now.line.lane_width, "over 0 m");
  }
  wrong = wrong_number(
      "line", {{"road_left", now.line.road_left}, {"road_right", now.line.road_right}});
  if (!wrong.empty()) return wrong;
  for (std::size_t n = 0; n < now.others.size(); ++n) {
    const Other& o = now.others[n];
    const std::string name = index_text("others", n);
    if (o.kind < ObstacleKind::kVehicle || o.kind > ObstacleKind::kStatic) {
      return fault(name + ".kind", static_cast<double>(o.kind), "kVehicle to kStatic");
    }
    wrong = wrong_number(name, {{"x", o.x}, {"y", o.y}, {"heading", o.heading}, {"speed", o.speed},
                                {"acceleration", o.acceleration}, {"length", o.length},
                                {"width", o.width}});
    if (wrong.empty()) wrong = wrong_prediction(name, o.prediction);
    if (!wrong.empty()) return wrong;
  }
  std::vector<std::pair<const char*, double>> places;
  for (const Signal& one : now.signals) places.insert(places.end(), {{"x", one.x}, {"y", one.y}});
  for (const XY& one : now.destination) places.insert(places.end(), {{"x", one[0]}, {"y", one[1]}});
  return wrong_number("signals or destination", places);
}

}  // namespace detail

}  // namespace rcirl

#endif  // RCIRL_SURROUNDINGS_HPP_
