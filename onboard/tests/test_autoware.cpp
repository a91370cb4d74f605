// The metric for Autoware's ranker against a stand-in of the ranker: test_autoware WEIGHTS.
#include <cmath>
#include <iostream>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

#include "../adapters/autoware/reward_metric.hpp"
#include "check.hpp"

namespace {

namespace ranker = autoware::trajectory_ranker;
using rcirl_autoware::RewardMetric;
constexpr double kTurn = 0.3, kX = 1000.0, kY = -2000.0;  // of the road in the map

// A pose at a station and an offset of a straight road.
stand_in::Pose on_road(double s, double l) {
  stand_in::Pose pose;
  pose.position.x = kX + s * std::cos(kTurn) - l * std::sin(kTurn);
  pose.position.y = kY + s * std::sin(kTurn) + l * std::cos(kTurn);
  pose.orientation.z = std::sin(0.5 * kTurn);
  pose.orientation.w = std::cos(0.5 * kTurn);
  return pose;
}

// Another car, with a less likely class before the likely one.
stand_in::PredictedObject other(double s, double l, double speed) {
  stand_in::PredictedObject object;
  object.classification.resize(2);
  object.classification[0] = {stand_in::ObjectClassification::PEDESTRIAN, 0.2f};
  object.classification[1] = {stand_in::ObjectClassification::CAR, 0.8f};
  object.kinematics.initial_pose_with_covariance.pose = on_road(s, l);
  object.kinematics.initial_twist_with_covariance.twist.linear.x = speed;
  object.shape.dimensions = {4.5, 1.8, 1.5};
  return object;
}

// 12 m/s, an acceleration held for 8.1 s, 40 m behind a car of 8 m/s; the rear axle is
// 1.4 m behind the centre.
std::shared_ptr<ranker::DataInterface> driven(double a, std::size_t samples = 82) {
  auto data = std::make_shared<ranker::DataInterface>();
  for (std::size_t i = 0; i < samples; ++i) {
    const double t = 0.1 * static_cast<double>(i);
    stand_in::TrajectoryPoint point;
    point.time_from_start = {static_cast<std::int32_t>(i / 10),
                             static_cast<std::uint32_t>(i % 10) * 100000000u};
    point.pose = on_road(12.0 * t + 0.5 * a * t * t - 1.4, 0.0);
    point.longitudinal_velocity_mps = static_cast<float>(12.0 + a * t);
    point.acceleration_mps2 = static_cast<float>(a);
    data->points()->push_back(point);
  }
  data->objects()->objects.push_back(other(40.0, 0.0, 8.0));
  lanelet::ConstLanelet lane;
  lane.speed_limit = 50.0;
  for (double s = -40.0; s <= 200.0; s += 10.0) {
    const stand_in::Pose pose = on_road(s, 0.0);
    lane.points.emplace_back(pose.position.x, pose.position.y);
  }
  data->preferred_lanes()->push_back(lane);
  return data;
}

std::shared_ptr<RewardMetric> metric(const char* weights) {
  auto made = std::make_shared<RewardMetric>(weights);
  autoware::vehicle_info_utils::VehicleInfo car;
  car.wheel_base_m = 2.8, car.vehicle_length_m = 4.9, car.vehicle_width_m = 2.1;
  car.min_longitudinal_offset_m = -1.05, car.max_longitudinal_offset_m = 3.85;
  made->init(std::make_shared<autoware::vehicle_info_utils::VehicleInfo>(car), 0.1f);
  made->set_index(1);
  return made;
}

// What the metric has to be, by the headers alone.
float wanted(const char* weights, double a, float scale) {
  rcirl::Surroundings now;
  now.ego.speed = 12.0, now.ego.acceleration = a, now.ego.length = 4.9, now.ego.width = 2.1;
  now.line.points = {{-40.0, 0.0}, {500.0, 0.0}};
  now.line.speed_limit = {50.0 / 3.6};
  now.others.resize(1);
  now.others[0].x = 40.0, now.others[0].speed = 8.0;
  now.others[0].length = 4.5, now.others[0].width = 1.8;
  rcirl::Reward reward;
  rcirl::FeatureMap columns;
  rcirl::Scene scene;
  CHECK(rcirl::load(weights, &reward).ok());
  CHECK(rcirl::feature_map(reward, &columns).ok());
  CHECK_TEXT(rcirl::scene_from(now, &scene).message(), "");
  std::vector<float> s, l(2 * rcirl::kTimes, 0.0f);
  for (const double held : {a, 0.0}) {
    for (int i = 0; i < 18; ++i) {
      const double t = 8.0 * i / 17.0;
      s.push_back(static_cast<float>(12.0 * t + 0.5 * held * t * t));
    }
  }
  std::vector<float> features(2 * rcirl::kTimes * columns.size()), values(2);
  rcirl::Workspace workspace = reward.workspace();
  columns.compute(scene, {s.data(), l.data(), 2}, features.data());
  reward.score(features.data(), 2, columns.mask(scene), &workspace, values.data());
  return 1.0f / (1.0f + std::exp((values[1] - values[0]) / scale));
}

void test_values(const char* weights) {
  const auto made = metric(weights);
  CHECK_TEXT(made->name(), "RcirlReward");
  CHECK(!made->is_deviation());
  for (const double a : {-1.0, -0.5, 0.0, 0.5}) {
    const auto data = driven(a);
    made->evaluate(data, 2.0f);
    const std::vector<float>& found = data->metric(1);
    CHECK(found.size() == 82);
    CHECK(std::abs(found.front() - wanted(weights, a, 2.0f)) < 2e-3f);
    CHECK(found.front() == found.back());
  }
}

// The ranker repeats the last point of candidates that end early: fewer times count.
void test_short_candidates(const char* weights) {
  const auto made = metric(weights), last = metric(weights);
  const auto data = driven(-0.5, 40), longer = driven(-0.5, 40);
  for (int i = 0; i < 42; ++i) longer->points()->push_back(longer->points()->back());
  made->evaluate(data, 2.0f);
  made->evaluate(longer, 2.0f);
  CHECK(data->metric(1).front() > 0.0f);
  CHECK(data->metric(1).front() == longer->metric(1).front());
  const auto none = driven(0.0, 1);
  made->evaluate(none, 2.0f);
  CHECK(none->metric(1).front() == 0.0f);
}

void test_what_cannot_be_valued(const char* weights) {
  const auto nowhere = driven(0.0);
  nowhere->preferred_lanes()->clear();
  metric(weights)->evaluate(nowhere, 2.0f);
  CHECK(nowhere->metric(1).front() == 0.0f);
  const auto data = driven(0.0);
  metric("none")->evaluate(data, 2.0f);
  CHECK(data->metric(1) == std::vector<float>(82, 0.0f));
}

// A polygon and a cylinder count as the box that they fill; a polygon's outline stands in
// the object's frame and need not lie around its place.
void test_shapes(const char* weights) {
  const auto made = metric(weights);
  const auto valued = [&](const stand_in::PredictedObject& object, double a) {
    const auto data = driven(a);
    data->objects()->objects = {object};
    made->evaluate(data, 2.0f);
    return data->metric(1).front();
  };
  const auto box = [](double s, double l, double length, double width) {
    stand_in::PredictedObject object = other(s, l, 0.0);
    object.shape.dimensions = {length, width, 1.5};
    return object;
  };
  stand_in::PredictedObject polygon = box(52.0, -0.2, 0.0, 0.0);  // its box's middle: 60, 1.8
  polygon.shape.type = stand_in::Shape::POLYGON;
  polygon.shape.footprint.points = {
      {2.0f, 0.5f, 0.0f}, {14.0f, 1.0f, 0.0f}, {13.0f, 3.5f, 0.0f}, {3.0f, 2.0f, 0.0f}};
  stand_in::PredictedObject cylinder = box(60.0, 1.8, 3.0, 0.0);
  cylinder.shape.type = stand_in::Shape::CYLINDER;
  for (const double a : {-1.4, 0.0, 0.5}) {
    CHECK(std::abs(valued(polygon, a) - valued(box(60.0, 1.8, 12.0, 3.0), a)) < 1e-5f);
    CHECK(std::abs(valued(cylinder, a) - valued(box(60.0, 1.8, 3.0, 3.0), a)) < 1e-6f);
  }
  CHECK(std::abs(valued(polygon, 0.5) - valued(box(60.0, 1.8, 0.3, 0.3), 0.5)) > 1e-3f);
  polygon.shape.footprint.points.clear();
  polygon.shape.dimensions = {4.0, 2.0, 1.5};
  CHECK(valued(polygon, 0.0) == valued(box(52.0, -0.2, 4.0, 2.0), 0.0));
}

// The ranker has weights of time for its first six metrics only: said once, of a later one.
void test_place(const char* weights) {
  const std::string wanted =
      "rcirl: metrics.name: RcirlReward at place 8: expected one of the first 6; the ranker "
      "gives no weight to a later one\n";
  for (const std::size_t index : {std::size_t{5}, std::size_t{7}}) {
    const auto made = metric(weights);
    made->set_index(index);
    std::ostringstream said;
    std::streambuf* usual = std::cerr.rdbuf(said.rdbuf());
    made->evaluate(driven(0.0), 2.0f);
    made->evaluate(driven(0.5), 2.0f);
    std::cerr.rdbuf(usual);
    CHECK_TEXT(said.str(), index < 6 ? "" : wanted);
  }
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 2) return 2;
  test_values(arguments[1]);
  test_short_candidates(arguments[1]);
  test_what_cannot_be_valued(arguments[1]);
  test_shapes(arguments[1]);
  test_place(arguments[1]);
  return failures == 0 ? 0 : 1;
}
