// F by its definitions; tests/onboard/test_features.py compares it with JAX.
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "check.hpp"
#include "files.hpp"
#include "rcirl/features.hpp"

namespace {

using rcirl::detail::kNumColumns;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kDt = 8.0f / 17.0f;

std::vector<rcirl::Feature> every_feature() {
  std::vector<rcirl::Feature> features;
  for (const auto& column : rcirl::detail::kColumns) {
    features.push_back({column.name, column.unit, 0.0});
  }
  return features;
}

rcirl::FeatureMap every_column() {
  rcirl::FeatureMap map;
  CHECK_TEXT(rcirl::feature_map(every_feature(), "w", &map).message(), "");
  return map;
}

// A straight road with a limit of 25 m/s; the ego is 4 m by 2 m and drives at 10 m/s.
rcirl::Scene road() {
  rcirl::Scene scene;
  scene.ego.v = 10.0f;
  scene.ego.length = 4.0f;
  scene.ego.width = 2.0f;
  scene.path.speed_limit.fill(25.0f);
  return scene;
}

// A box of 4 m by 2 m that keeps its speed.
rcirl::Obstacle body(float s, float l, float speed) {
  rcirl::Obstacle box;
  box.kind = rcirl::ObstacleKind::kVehicle;
  for (std::size_t t = 0; t < rcirl::kTimes; ++t) {
    const float middle = s + speed * kDt * static_cast<float>(t);
    box.s_lower[t] = middle - 2.0f;
    box.s_upper[t] = middle + 2.0f;
    box.l_lower[t] = l - 1.0f;
    box.l_upper[t] = l + 1.0f;
    box.speed[t] = speed;
    box.valid[t] = 1;
  }
  return box;
}

std::vector<float> steady(float v, std::size_t count = 1) {
  std::vector<float> s;
  for (std::size_t i = 0; i < count * rcirl::kTimes; ++i) {
    s.push_back(v * kDt * static_cast<float>(i % rcirl::kTimes));
  }
  return s;
}

// All columns of one candidate at constant speed along the path, at time t.
std::vector<float> columns(const rcirl::Scene& scene, std::size_t t, float v = 10.0f) {
  const std::vector<float> s = steady(v);
  std::vector<float> all(rcirl::kTimes * kNumColumns);
  CHECK(every_column().compute(scene, {s.data(), nullptr, 1}, all.data()) == 0);
  const auto first = all.begin() + static_cast<long>(t * kNumColumns);
  return std::vector<float>(first, first + static_cast<long>(kNumColumns));
}

bool near(float found, float wanted) { return std::abs(found - wanted) < 1e-4f; }

void test_an_empty_road() {
  const std::vector<float> x = columns(road(), 17);
  namespace d = rcirl::detail;
  CHECK(near(x[d::kStation], 80.0f) && near(x[d::kTime], 8.0f));
  CHECK(near(x[d::kVelocity], 10.0f) && near(x[d::kSpeedLimit], 25.0f));
  CHECK(near(x[d::kAcceleration], 0.0f) && near(x[d::kJerk], 0.0f));
  CHECK(x[d::kFollowDistance] == 100.0f && x[d::kFollowSpeed] == 0.0f);
  CHECK(x[d::kStopDistance] == 60.0f && x[d::kNudgeLateral] == 10.0f);
  CHECK(x[d::kCollisionDistance] == 100.0f && x[d::kCollision] == 0.0f);
}

void test_classes_of_bodies() {
  namespace d = rcirl::detail;
  rcirl::Scene scene = road();
  scene.obstacles = {body(20.0f, 0.0f, 10.0f), body(-30.0f, 0.5f, 12.0f), body(1.0f, 3.5f, 10.0f),
                     body(25.0f, -4.0f, 8.0f)};
  const std::vector<float> x = columns(scene, 0);
  CHECK(near(x[d::kFollowDistance], 16.0f) && near(x[d::kFollowSpeed], 0.0f));
  CHECK(near(x[d::kOvertakeDistance], 26.0f) && near(x[d::kOvertakeSpeed], 2.0f));
  CHECK(near(x[d::kNudgeLateral], 1.5f) && x[d::kNudgeDistance] == 0.0f);
  CHECK(near(x[d::kSidepassFrontDistance], 21.0f) && near(x[d::kSidepassFrontSpeed], -2.0f));
  CHECK(near(x[d::kCollisionDistance], 1.5f));
  scene.obstacles = {body(3.0f, 0.5f, 10.0f)};  // 1 m deep along, 1.5 m across
  CHECK(near(columns(scene, 0)[d::kCollisionDistance], -1.0f));
  CHECK(columns(scene, 0)[d::kCollision] == 1.0f);
}

void test_a_line_is_overrun_once() {
  namespace d = rcirl::detail;
  rcirl::Scene scene = road();
  rcirl::Obstacle line = body(20.0f, 0.0f, 0.0f);
  line.kind = rcirl::ObstacleKind::kStop;
  scene.obstacles = {line};
  CHECK(near(columns(scene, 0)[d::kStopDistance], 16.0f));
  CHECK(near(columns(scene, 3)[d::kCollisionDistance], 100.0f));
  CHECK(near(columns(scene, 4)[d::kCollisionDistance], -(40.0f * kDt - 16.0f)));
  CHECK(near(columns(scene, 5)[d::kCollisionDistance], 100.0f));
  CHECK(columns(scene, 5)[d::kStopDistance] == 60.0f);
}

void test_candidates_do_not_depend_on_their_neighbours() {
  rcirl::Scene scene = road();
  scene.obstacles = {body(20.0f, 0.0f, 5.0f)};
  constexpr std::size_t kCount = 70;
  const std::size_t row = rcirl::kTimes * kNumColumns;
  std::vector<float> s = steady(10.0f, kCount), all(kCount * row), one(row);
  for (std::size_t k = 0; k < kCount; ++k) {
    for (std::size_t t = 0; t < rcirl::kTimes; ++t) {
      s[k * rcirl::kTimes + t] *= static_cast<float>(k) / 40.0f;
    }
  }
  const rcirl::FeatureMap map = every_column();
  CHECK(map.compute(scene, {s.data(), nullptr, kCount}, all.data()) == 0);
  for (std::size_t k = 0; k < kCount; ++k) {
    map.compute(scene, {&s[k * rcirl::kTimes], nullptr, 1}, one.data());
    CHECK(std::equal(one.begin(), one.end(), all.begin() + static_cast<long>(k * row)));
  }
}

void test_what_is_not_finite_is_refused() {
  std::vector<float> s = steady(10.0f, 3), l(s.size(), 0.0f), all(3 * rcirl::kTimes * kNumColumns);
  l[rcirl::kTimes + 5] = kNan;
  const rcirl::FeatureMap map = every_column();
  CHECK(map.compute(road(), {s.data(), nullptr, 3}, all.data()) == 0);
  CHECK(map.compute(road(), {s.data(), l.data(), 3}, all.data()) == 1);
  const std::size_t row = rcirl::kTimes * kNumColumns;
  for (std::size_t i = 0; i < all.size(); ++i) CHECK(std::isnan(all[i]) == (i / row == 1));
  rcirl::Scene scene = road();
  scene.path.kappa[7] = kNan;
  CHECK(map.compute(scene, {s.data(), nullptr, 3}, all.data()) == 3);
  for (const float value : all) CHECK(std::isnan(value));
}

void test_faults_have_one_line() {
  rcirl::Scene scene = road();
  CHECK(rcirl::check(scene).ok());
  scene.obstacles = {body(20.0f, 0.0f, 5.0f), body(20.0f, 0.0f, 5.0f)};
  scene.obstacles[0].valid.fill(0);
  scene.obstacles[0].speed.fill(kNan);
  CHECK(rcirl::check(scene).ok());  // nobody reads what is not there
  scene.obstacles[1].s_lower[2] = kNan;
  CHECK_TEXT(rcirl::check(scene).message(),
             "scene: obstacles[1].s_lower[2]: nan: expected a finite number");
  scene.obstacles[1].s_lower[2] = 1e6f;
  CHECK_TEXT(rcirl::check(scene).message(),
             "scene: obstacles[1].s_lower[2]: 1000000: expected at most s_upper");
  scene.num_valid = 0;
  CHECK_TEXT(rcirl::check(scene).message(), "scene: num_valid: 0: expected 1 to 18");
  scene.path.speed_limit[3] = -1.0f;
  CHECK_TEXT(rcirl::check(scene).message(), "scene: path.speed_limit[3]: -1: expected >= 0 m/s");
  scene.ego.width = 0.0f;
  CHECK_TEXT(rcirl::check(scene).message(), "scene: ego.width: 0: expected over 0 m");
  rcirl::FeatureMap map;
  std::vector<rcirl::Feature> features = every_feature();
  features[2].name = "weather";
  CHECK_TEXT(rcirl::feature_map(features, "w", &map).message(),
             "w: features[2]: weather: expected a column of docs/features.md");
  CHECK(map.size() == 0);
  features = every_feature();
  features[4].unit = "ft";
  CHECK_TEXT(rcirl::feature_map(features, "w", &map).message(),
             "w: features[4]: station: ft: expected m");
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::feature_map(reward, &map).message(),
             ": times: another grid: expected 8 i / 17 s, i = 0 .. 17");
}

void test_the_mask_says_which_times_count() {
  rcirl::Scene scene = road();
  const rcirl::FeatureMap map = every_column();
  for (std::size_t valid = 1; valid <= rcirl::kTimes; ++valid) {
    scene.num_valid = valid;
    const rcirl::Mask mask = map.mask(scene);
    for (std::size_t t = 0; t < rcirl::kTimes; ++t) CHECK(mask.data[t] == (t < valid));
  }
}

}  // namespace

int main() {
  test_an_empty_road();
  test_classes_of_bodies();
  test_a_line_is_overrun_once();
  test_candidates_do_not_depend_on_their_neighbours();
  test_what_is_not_finite_is_refused();
  test_faults_have_one_line();
  test_the_mask_says_which_times_count();
  return failures == 0 ? 0 : 1;
}
