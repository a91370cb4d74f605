// The evaluator for Apollo's lattice planner against a stand-in of its types: test_apollo
// CONFORMANCE, the folder of the conformance cases.
#include <cmath>
#include <cstdint>
#include <fstream>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include <lattice.hpp>

#include "../adapters/apollo/reward_evaluator.hpp"
#include "check.hpp"
#include "files.hpp"

namespace {

using apollo::common::PathPoint;
using apollo::planning::Curve1d;
using apollo::planning::TrajectoryEvaluator;
using rcirl_apollo::LearnedCost;
using rcirl_apollo::RewardEvaluator;
using Pair = TrajectoryEvaluator::Trajectory1dPair;

constexpr double kTurn = 0.3, kX = 1000.0, kY = -2000.0;  // of the road in the map
constexpr double kAt = 50.0;  // m, the car's station on the reference line

// Stations at the T times, linear between, beyond the car's own.
class Along : public Curve1d {
 public:
  explicit Along(std::vector<double> s) : s_(std::move(s)) {}
  double Evaluate(const std::uint32_t, const double t) const override {
    const double place = std::min(t / 8.0 * 17.0, 17.0);
    const auto low = std::min(static_cast<std::size_t>(place), std::size_t{16});
    return kAt + s_[low] + (place - static_cast<double>(low)) * (s_[low + 1] - s_[low]);
  }

 private:
  std::vector<double> s_;
};

// An offset that is held.
class Aside : public Curve1d {
 public:
  explicit Aside(double l) : l_(l) {}
  double Evaluate(const std::uint32_t order, const double) const override {
    return order == 0 ? l_ : 0.0;
  }

 private:
  double l_;
};

PathPoint on_road(double s) {
  return {kX + s * std::cos(kTurn), kY + s * std::sin(kTurn), kTurn, 0.0, s};
}

// A moment on a straight road, as the planner has it.
struct Moment {
  apollo::common::TrajectoryPoint start;
  std::vector<PathPoint> points;
  apollo::planning::ReferenceLine line;
  std::vector<apollo::planning::Obstacle> others;
  apollo::common::VehicleParam car;
  apollo::planning::PlanningTarget target;

  explicit Moment(double v) {
    for (double s = 0.0; s <= 600.0; s += 1.0) points.push_back(on_road(s));
    start.path_point_ = on_road(kAt);
    start.v_ = v;
  }

  rcirl::Surroundings surroundings() const {
    std::vector<const apollo::planning::Obstacle*> pointers;
    for (const auto& one : others) pointers.push_back(&one);
    return rcirl_apollo::surroundings(start, points, line, pointers, car, target);
  }
};

struct Ranked {
  std::vector<Pair> pairs;
  std::vector<double> costs;
};

Ranked ranked(const std::vector<std::pair<Pair, double>>& pairs, const LearnedCost& learned,
              const rcirl::Surroundings& now, const std::string& wanted = "") {
  TrajectoryEvaluator apollo(pairs);
  const std::vector<double> init_s = {kAt, 13.0, 0.0};
  RewardEvaluator<TrajectoryEvaluator> evaluator(&apollo, learned, now, init_s, 1.4);
  CHECK_TEXT(evaluator.status().message(), wanted);
  CHECK(evaluator.num_of_trajectory_pairs() == pairs.size());
  Ranked found;
  while (evaluator.has_more_trajectory_pairs()) {
    found.costs.push_back(evaluator.top_trajectory_pair_cost());
    found.pairs.push_back(evaluator.next_top_trajectory_pair());
  }
  return found;
}

// The case free_road of cases.txt: its candidates, and their scores by JAX.
struct FreeRoad {
  std::vector<double> ego, scores;
  std::vector<std::shared_ptr<Curve1d>> along;

  explicit FreeRoad(const std::string& folder) {
    std::ifstream file(folder + "/cases.txt");
    std::string word, name;
    while (file >> word && name != "end") {
      if (word == "case") file >> name;
      if (name != "free_road") continue;
      if (word == "ego") ego = numbers(&file, 8);
      if (word == "s") along.push_back(std::make_shared<Along>(numbers(&file, 18)));
      if (word == "scores") scores = numbers(&file, along.size()), name = "end";
    }
  }

  static std::vector<double> numbers(std::ifstream* file, std::size_t count) {
    std::vector<double> found(count);
    for (double& one : found) *file >> one;
    return found;
  }
};

void test_costs_are_the_scores_of_the_conformance_case(const std::string& folder) {
  const FreeRoad given(folder);
  CHECK(given.scores.size() == 3);
  Moment moment(given.ego[4]);
  moment.car.length_ = given.ego[6], moment.car.width_ = given.ego[7];
  moment.line.limit = 25.0;
  const LearnedCost learned((folder + "/paper21.msgpack").c_str());
  CHECK_TEXT(learned.status().message(), "");
  const auto left = std::make_shared<Aside>(0.5), middle = std::make_shared<Aside>(0.0);
  std::vector<std::pair<Pair, double>> pairs;
  for (const auto& one : given.along) {
    pairs.push_back({{one, left}, 2.0});
    pairs.push_back({{one, middle}, 1.0});
  }
  const Ranked found = ranked(pairs, learned, moment.surroundings());
  CHECK(found.pairs.size() == 6);
  for (std::size_t i = 0; i < found.pairs.size(); ++i) {
    const auto& [lon, lat] = found.pairs[i];
    for (std::size_t k = 0; k < given.along.size(); ++k) {
      if (given.along[k] == lon) CHECK(std::abs(found.costs[i] + given.scores[k]) < 1e-4);
    }
    CHECK(i == 0 || found.costs[i] >= found.costs[i - 1]);
    CHECK((lat == middle) == (i % 2 == 0));  // Apollo's cost among equals
  }
  CHECK(found.pairs.back().first == given.along[1]);  // the rough one is the last
}

// With a gain of 2 on Apollo's cost.
Example gained() {
  Example example = likes_speed();
  example.gain = 2.0;
  return example;
}

// V is the sum of stations: 85 m for 1 m/s along the 18 times, twice that at a gain of 2.
void test_the_gained_value_comes_off_apollos_cost() {
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::decode(gained().file(), "w", &reward).message(), "");
  const LearnedCost learned(reward);
  std::vector<std::pair<Pair, double>> pairs;
  for (const double v : {10.0, 9.0, 8.0}) {
    std::vector<double> s;
    for (int t = 0; t < 18; ++t) s.push_back(v * 8.0 * t / 17.0);
    pairs.push_back({{std::make_shared<Along>(s), std::make_shared<Aside>(0.0)}, 180.0 * v});
  }
  // 1 m/s is worth 2 * 8 / 17 * 153 = 144 and costs 180
  const Ranked found = ranked(pairs, learned, Moment(10.0).surroundings());
  CHECK(found.pairs.size() == 3 && found.pairs[0] == pairs[2].first);
  for (std::size_t i = 0; i < found.costs.size(); ++i) {
    CHECK(std::abs(found.costs[i] - 36.0 * (8.0 + static_cast<double>(i))) < 1e-2);
  }
}

void test_what_is_around() {
  Moment moment(12.0);
  moment.target.has_stop_point_ = true;
  moment.target.stop_point_.s_ = kAt + 60.0;
  apollo::planning::Obstacle other;
  const PathPoint place = on_road(kAt + 40.0);
  other.box_ = {place.x(), place.y(), kTurn, 1.8, 0.6};
  other.speed_ = 4.0;
  other.perception_ = {7, apollo::perception::PerceptionObstacle::BICYCLE};
  moment.others = {other, other, other};  // two predictions of one, and a wall
  moment.others[2].perception_.id_ = 8;
  moment.others[2].is_virtual_ = true;
  rcirl::Scene scene;
  CHECK_TEXT(rcirl::scene_from(moment.surroundings(), &scene).message(), "");
  CHECK(scene.obstacles.size() == 2);
  const double ahead = rcirl_apollo::to_centre(moment.car);
  const auto is = [](float found, double wanted) { return std::abs(double{found} - wanted) < 1e-2; };
  const rcirl::Obstacle &bicycle = scene.obstacles[0], &line = scene.obstacles[1];
  CHECK(bicycle.kind == rcirl::ObstacleKind::kCyclist);
  CHECK(is(bicycle.s_lower[0], 40.0 - 0.9 - ahead) && is(bicycle.speed[0], 4.0));
  CHECK(line.kind == rcirl::ObstacleKind::kStop);
  CHECK(is(line.s_lower[0], 60.0 + moment.car.front_edge_to_center() - ahead));
}

void test_without_a_value_apollos_order_stays() {
  Moment moment(12.0);
  const auto curve = std::make_shared<Along>(std::vector<double>(18, 0.0));
  const std::vector<std::pair<Pair, double>> pairs = {
      {{curve, std::make_shared<Aside>(0.2)}, 2.0}, {{curve, std::make_shared<Aside>(0.0)}, 1.0}};
  const LearnedCost none("no_such_file");
  CHECK(!none.status().ok());
  Ranked found = ranked(pairs, none, moment.surroundings(), none.status().message());
  CHECK((found.costs == std::vector<double>{1.0, 2.0}));
  rcirl::Reward reward;
  CHECK(rcirl::decode(gained().file(), "w", &reward).ok());
  rcirl::Surroundings nowhere = moment.surroundings();
  nowhere.line.points.clear(), nowhere.line.speed_limit.clear();
  found = ranked(pairs, LearnedCost(reward), nowhere,
                 "scene_from: line.points: 0: expected a line of 1 m to 100 km");
  CHECK((found.costs == std::vector<double>{1.0, 2.0}));
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 2) return 2;
  test_costs_are_the_scores_of_the_conformance_case(arguments[1]);
  test_the_gained_value_comes_off_apollos_cost();
  test_what_is_around();
  test_without_a_value_apollos_order_stays();
  return failures == 0 ? 0 : 1;
}
