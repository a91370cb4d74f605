// One planning frame in plain numbers: what the feature map F reads.
//
// Everything is in the scene's Frenet frame, SI units and radians: station `s` along the
// reference line, 0 at the ego's centre now; lateral offset `l` from it, left positive;
// `dl` and `ddl` are derivatives of `l` by station. docs/own_planner.md describes every
// field; `rcirl_jax/export/own_planner/features.py` has the same structs.
#ifndef RCIRL_SCENE_HPP_
#define RCIRL_SCENE_HPP_

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "rcirl/detail/text.hpp"
#include "rcirl/status.hpp"

namespace rcirl {

constexpr std::size_t kTimes = 18;      // T, points on the time axis, t = 8 i / 17 s
constexpr float kHorizonS = 8.0f;       // s
constexpr std::size_t kStations = 128;  // P, points of the station grid
constexpr float kStationStepM = 2.0f;   // m between them

using Times = std::array<float, kTimes>;
using Stations = std::array<float, kStations>;

// The controlled car now.
struct Ego {
  float s = 0.0f;       // m, station of the centre
  float l = 0.0f;       // m, lateral offset of the centre
  float dl = 0.0f;      // 1, dl/ds
  float ddl = 0.0f;     // 1/m, d2l/ds2
  float v = 0.0f;       // m/s along the reference line
  float a = 0.0f;       // m/s^2 along the reference line
  float length = 0.0f;  // m, to be set
  float width = 0.0f;   // m, to be set
};

constexpr float kUnknownEdgeM = 1e6f;  // m, a road's edge that is not known

namespace detail {

inline Stations everywhere(float value) {
  Stations table{};
  table.fill(value);
  return table;
}

}  // namespace detail

// The reference line and the given path; point p lies at station 2 p m.
struct Path {
  Stations kappa{};  // 1/m, curvature of the reference line, left positive
  Stations l{};      // m, lateral offset of the given path
  // m/s, that the planner may drive: posted, for curves, braking for both
  Stations speed_limit{};
  // m, lateral offsets of the road's edges, for the safety filter alone
  Stations road_left = detail::everywhere(kUnknownEdgeM);
  Stations road_right = detail::everywhere(-kUnknownEdgeM);

  bool has_road() const {
    return road_left[0] < kUnknownEdgeM && road_right[0] > -kUnknownEdgeM;
  }
};

enum class ObstacleKind : std::uint8_t {
  kNone,        // an empty slot
  kVehicle,
  kCyclist,
  kPedestrian,
  kStatic,      // a standing object that never moves
  kStop,        // a stop line or a red light; valid only while it demands a stop
  kVirtual,     // the destination of the route
};

// One obstacle as a box along the road at every time; a line is a thin box.
struct Obstacle {
  ObstacleKind kind = ObstacleKind::kNone;
  Times s_lower{};  // m, station of the rear end
  Times s_upper{};  // m, station of the front end
  Times l_lower{};  // m, lateral offset of the right side
  Times l_upper{};  // m, lateral offset of the left side
  Times speed{};    // m/s along the reference line, signed
  std::array<std::uint8_t, kTimes> valid{};  // 1: there at that time (kStop: demands a stop)
};

struct Scene {
  Ego ego;
  Path path;
  std::vector<Obstacle> obstacles;  // in any order, as many as there are
  std::size_t num_valid = kTimes;   // times that count, from the first; online all
};

namespace detail {

// Calls `report(field, index or -1, value, expected)` for what is wrong with some numbers,
// until it returns true; returns whether it did.
template <typename Values, typename Report>
bool not_finite(const char* field, const Values& values, const Report& report) {
  for (std::size_t i = 0; i < values.size(); ++i) {
    if (!std::isfinite(values[i])) return report(field, i, values[i], "a finite number");
  }
  return false;
}

template <typename Report>
bool bad_ego(const Ego& ego, const Report& report) {
  const char* names[] = {"ego.s", "ego.l", "ego.dl",     "ego.ddl",
                         "ego.v", "ego.a", "ego.length", "ego.width"};
  const float values[] = {ego.s, ego.l, ego.dl, ego.ddl, ego.v, ego.a, ego.length, ego.width};
  for (std::size_t i = 0; i < 8; ++i) {
    if (!std::isfinite(values[i])) return report(names[i], kTimes, values[i], "a finite number");
    if (i >= 6 && !(values[i] > 0.0f)) return report(names[i], kTimes, values[i], "over 0 m");
  }
  return false;
}

template <typename Report>
bool bad_path(const Path& path, const Report& report) {
  if (not_finite("path.kappa", path.kappa, report)) return true;
  if (not_finite("path.l", path.l, report)) return true;
  if (not_finite("path.speed_limit", path.speed_limit, report)) return true;
  if (not_finite("path.road_left", path.road_left, report)) return true;
  if (not_finite("path.road_right", path.road_right, report)) return true;
  for (std::size_t p = 0; p < kStations; ++p) {
    const float limit = path.speed_limit[p], left = path.road_left[p];
    if (limit < 0.0f) return report("path.speed_limit", p, limit, ">= 0 m/s");
    if (left < path.road_right[p]) {
      return report("path.road_left", p, left, "at least road_right");
    }
  }
  return false;
}

template <typename Report>
bool bad_obstacle(const Obstacle& box, const Report& report) {
  constexpr const char* kFinite = "a finite number";
  if (box.kind > ObstacleKind::kVirtual) {
    return report("kind", kTimes, static_cast<float>(box.kind), "0 to 6");
  }
  for (std::size_t t = 0; t < kTimes; ++t) {
    if (box.valid[t] > 1) return report("valid", t, static_cast<float>(box.valid[t]), "0 or 1");
    if (box.valid[t] == 0) continue;
    if (!std::isfinite(box.s_lower[t])) return report("s_lower", t, box.s_lower[t], kFinite);
    if (!std::isfinite(box.s_upper[t])) return report("s_upper", t, box.s_upper[t], kFinite);
    if (!std::isfinite(box.l_lower[t])) return report("l_lower", t, box.l_lower[t], kFinite);
    if (!std::isfinite(box.l_upper[t])) return report("l_upper", t, box.l_upper[t], kFinite);
    if (!std::isfinite(box.speed[t])) return report("speed", t, box.speed[t], kFinite);
    if (box.s_lower[t] > box.s_upper[t]) {
      return report("s_lower", t, box.s_lower[t], "at most s_upper");
    }
    if (box.l_lower[t] > box.l_upper[t]) {
      return report("l_lower", t, box.l_lower[t], "at most l_upper");
    }
  }
  return false;
}

// The first fault of a scene is given to `report(obstacle or none, field, index, value,
// expected)`; returns whether there is one. Allocates nothing by itself.
template <typename Report>
bool bad_scene(const Scene& scene, const Report& report) {
  const std::size_t none = scene.obstacles.size();
  const auto whole = [&](const char* field, std::size_t at, float value, const char* wanted) {
    return report(none, field, at, value, wanted);
  };
  if (bad_ego(scene.ego, whole) || bad_path(scene.path, whole)) return true;
  if (scene.num_valid < 1 || scene.num_valid > kTimes) {
    return whole("num_valid", kStations, static_cast<float>(scene.num_valid), "1 to 18");
  }
  for (std::size_t n = 0; n < none; ++n) {
    const auto one = [&](const char* field, std::size_t at, float value, const char* wanted) {
      return report(n, field, at, value, wanted);
    };
    if (bad_obstacle(scene.obstacles[n], one)) return true;
  }
  return false;
}

inline bool usable(const Scene& scene) {
  return !bad_scene(scene, [](auto...) { return true; });
}

}  // namespace detail

// Whether every number of a scene is there and in range; else the first that is not, as
// "scene: obstacles[3].s_lower[2]: nan: expected a finite number".
inline Status check(const Scene& scene) {
  std::string line;
  const auto report = [&](std::size_t obstacle, const std::string& field, std::size_t at,
                          float value, const char* expected) {
    const bool listed = field != "num_valid" && field != "kind" && field.rfind("ego.", 0) != 0;
    line = "scene: ";
    if (obstacle < scene.obstacles.size()) line += detail::index_text("obstacles", obstacle) + ".";
    line += listed ? detail::index_text(field, at) : field;
    line += ": " + detail::number_text(static_cast<double>(value)) + ": expected " + expected;
    return true;
  };
  return detail::bad_scene(scene, report) ? Status(line) : Status();
}

}  // namespace rcirl

#endif  // RCIRL_SCENE_HPP_
