// libFuzzer target: measurements of any bits make a scene that `check` takes, or one line.
//
// The first byte chooses how numbers are read: 0 as they are, 1 folded into a range that
// roads have.
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "bits.hpp"
#include "rcirl/scene_builder.hpp"

namespace {

struct Doubles : Bits {
  double number() {
    const std::uint8_t first = data[at % size];
    const double value = raw<double>();
    return folded ? static_cast<double>(static_cast<std::int8_t>(first)) / 8.0 : value;
  }

  double positive() { return folded ? 0.1 + std::abs(number()) : number(); }
};

std::vector<rcirl::detail::XY> points(Doubles* bits, std::size_t count) {
  std::vector<rcirl::detail::XY> found;
  double x = -40.0, y = 0.0;
  for (std::size_t i = 0; i < count; ++i) {
    const double dx = bits->number(), dy = bits->number();
    x = bits->folded ? x + std::abs(dx) : dx;
    y = bits->folded ? y + dy : dy;
    found.push_back({x, y});
  }
  return found;
}

rcirl::Surroundings surroundings(Doubles* bits) {
  rcirl::Surroundings now;
  rcirl::Car& e = now.ego;
  for (double* value : {&e.x, &e.y, &e.heading, &e.acceleration, &e.curvature}) {
    *value = bits->number();
  }
  for (double* value : {&e.speed, &e.length, &e.width, &now.line.lane_width}) {
    *value = bits->positive();
  }
  now.line.points = points(bits, bits->byte() % 32);
  now.line.speed_limit.resize(bits->byte() % 2 == 0 ? 1 : now.line.points.size());
  for (double& limit : now.line.speed_limit) limit = bits->positive();
  now.others.resize(bits->byte() % 12);
  for (rcirl::Other& o : now.others) {
    o.kind = static_cast<rcirl::ObstacleKind>(bits->byte() % 8);
    for (double* value : {&o.x, &o.y, &o.heading, &o.speed, &o.acceleration}) {
      *value = bits->number();
    }
    o.length = bits->positive();
    o.width = bits->positive();
    o.prediction.resize(bits->byte() % 4);
    double time = 0.0;
    for (rcirl::Pose& pose : o.prediction) {
      pose = {time, bits->number(), bits->number(), bits->number()};
      time += bits->positive();
    }
  }
  now.signals.resize(bits->byte() % 3);
  for (rcirl::Signal& signal : now.signals) {
    signal.x = bits->number();
    signal.y = bits->number();
    signal.state = static_cast<rcirl::SignalState>(bits->byte() % 5);
  }
  now.path = points(bits, bits->byte() % 8);
  now.destination = points(bits, bits->byte() % 2);
  return now;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 2) return 0;
  Doubles bits = {{data + 1, size - 1, 0, data[0] % 2 == 1}};
  rcirl::Scene scene;
  scene.num_valid = 0;  // as no scene that is made has it
  const rcirl::Status status = rcirl::scene_from(surroundings(&bits), &scene);
  if (status.ok()) {
    require(rcirl::check(scene).ok());
    return 0;
  }
  require(scene.num_valid == 0);
  require(status.message().rfind("scene", 0) == 0);
  require(status.message().find(": expected ") != std::string::npos);
  require(status.message().find_first_of("\r\n") == std::string::npos);
  return 0;
}
