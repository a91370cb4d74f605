// Ten candidates beside two cars, filtered, then judged by a learned reward:
// own_planner WEIGHTS. The Python twin, own_planner.py, prints the same numbers.
#include <algorithm>
#include <cstdio>
#include <string>
#include <vector>

#include "rcirl/choose.hpp"
#include "rcirl/scene_builder.hpp"

constexpr double kSpeed = 12.0;  // m/s, the ego's

// A car that keeps its speed. Without a prediction it is predicted as in training.
rcirl::Other car(double x, double y, double speed) {
  rcirl::Other made;
  made.x = x, made.y = y, made.speed = speed, made.length = 4.5, made.width = 1.8;
  made.prediction = {{0.0, x, y, 0.0}, {8.0, x + 8.0 * speed, y, 0.0}};
  return made;
}

// Stations [10, T]: an acceleration of -3 to 1.5 m/s^2, held until the ego stands.
std::vector<float> candidates() {
  std::vector<float> s;
  for (int k = 0; k < 10; ++k) {
    const double a = -3.0 + 0.5 * k;
    for (int i = 0; i < 18; ++i) {
      const double t = std::min(8.0 * i / 17.0, kSpeed / std::max(-a, 1e-9));
      s.push_back(static_cast<float>(kSpeed * t + 0.5 * a * t * t));
    }
  }
  return s;
}

int main(int count, char** arguments) {
  rcirl::Reward reward;
  rcirl::Chooser chooser;
  rcirl::Scene scene;
  rcirl::Surroundings now;  // metres, radians, any Cartesian frame
  now.ego.speed = kSpeed, now.ego.length = 4.9, now.ego.width = 2.1;
  now.line.points = {{-50.0, 0.0}, {300.0, 0.0}};
  now.line.speed_limit = {13.9};
  now.others = {car(30.0, 0.0, 8.0), car(-15.0, 3.6, 14.0)};
  rcirl::Status status = rcirl::load(count == 2 ? arguments[1] : "", &reward);
  if (status.ok()) status = rcirl::chooser(reward, {}, &chooser);
  if (status.ok()) status = rcirl::scene_from(now, &scene);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  std::printf("%s\n", describe(reward).c_str());  // what it was trained for, and what not
  const std::vector<float> s = candidates();
  const std::vector<float> own{-3, -2.5, -2, -1.5, -1, -0.5, 0, -0.5, -1, -1.5};  // -your cost
  // the safety filter first, then the value
  const rcirl::Choice choice = chooser.choose(scene, {s.data(), nullptr, 10}, own.data());
  for (std::size_t k = 0; k < 10; ++k) {
    const std::string why = text(chooser.rulings()[k]);
    std::printf("candidate %zu: %.9g %s\n", k, double{chooser.values()[k]},
                why.empty() ? "is admissible" : why.c_str());
  }
  if (choice.found()) std::printf("best: candidate %zu\n", choice.best);
  if (!choice.found()) std::printf("%s\n", chooser.why().c_str());
}
