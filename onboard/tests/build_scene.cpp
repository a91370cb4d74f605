// build_scene < SURROUNDINGS: what `scene_from` makes of numbers, for the Python tests.
//
// The numbers: the ego's 8; the line's width, road edges and points (x, y, limit) after their count;
// the others (kind and 7 more, then poses after their count); signals (x, y, state); the
// path's points; the destination's. Writes the scene as float32 in the order of flat.hpp,
// or its refusal to stderr.
#include <cstdio>
#include <vector>

#include "rcirl/scene_builder.hpp"

namespace {

double number() {
  double value = 0.0;
  return std::scanf("%lf", &value) == 1 ? value : 0.0;
}

std::size_t count() { return static_cast<std::size_t>(number()); }

std::vector<rcirl::detail::XY> points() {
  std::vector<rcirl::detail::XY> found(count());
  for (auto& [x, y] : found) x = number(), y = number();
  return found;
}

rcirl::Surroundings surroundings() {
  rcirl::Surroundings now;
  rcirl::Car& e = now.ego;
  for (double* value : {&e.x, &e.y, &e.heading, &e.speed, &e.acceleration, &e.curvature,
                        &e.length, &e.width}) {
    *value = number();
  }
  now.line.lane_width = number();
  now.line.road_left = number();
  now.line.road_right = number();
  for (std::size_t left = count(); left > 0; --left) {
    const double x = number(), y = number();
    now.line.points.push_back({x, y});
    now.line.speed_limit.push_back(number());
  }
  now.others.resize(count());
  for (rcirl::Other& o : now.others) {
    o.kind = static_cast<rcirl::ObstacleKind>(count());
    for (double* value :
         {&o.x, &o.y, &o.heading, &o.speed, &o.acceleration, &o.length, &o.width}) {
      *value = number();
    }
    o.prediction.resize(count());
    for (rcirl::Pose& pose : o.prediction) {
      for (double* value : {&pose.t, &pose.x, &pose.y, &pose.heading}) *value = number();
    }
  }
  now.signals.resize(count());
  for (rcirl::Signal& signal : now.signals) {
    signal.x = number();
    signal.y = number();
    signal.state = static_cast<rcirl::SignalState>(count());
  }
  now.path = points();
  now.destination = points();
  return now;
}

void write(const float* values, std::size_t size) { std::fwrite(values, 4, size, stdout); }

template <typename Array>
void write(const Array& values) {
  write(values.data(), values.size());
}

}  // namespace

int main() {
  rcirl::Scene scene;
  const rcirl::Status status = rcirl::scene_from(surroundings(), &scene);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  const rcirl::Ego& e = scene.ego;
  const float ego[] = {e.s, e.l, e.dl, e.ddl, e.v, e.a, e.length, e.width};
  write(ego, 8);
  write(scene.path.kappa);
  write(scene.path.l);
  write(scene.path.speed_limit);
  write(scene.path.road_left);
  write(scene.path.road_right);
  const float counts[] = {static_cast<float>(scene.num_valid),
                          static_cast<float>(scene.obstacles.size())};
  write(counts, 2);
  for (const rcirl::Obstacle& box : scene.obstacles) {
    const float kind = static_cast<float>(box.kind);
    write(&kind, 1);
    for (const rcirl::Times* table :
         {&box.s_lower, &box.s_upper, &box.l_lower, &box.l_upper, &box.speed}) {
      write(*table);
    }
    for (const std::uint8_t valid : box.valid) {
      const float there = valid;
      write(&there, 1);
    }
  }
  return 0;
}
