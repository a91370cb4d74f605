// The filter and the choice; tests/onboard compares both with Python and JAX.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <limits>
#include <string>
#include <vector>

#include "allocations.hpp"
#include "check.hpp"
#include "files.hpp"
#include "rcirl/choose.hpp"

namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kDt = 8.0f / 17.0f;
constexpr std::size_t kCount = 40;

rcirl::Reward loaded(const std::string& file) {
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::decode(file, "w", &reward).message(), "");
  return reward;
}

rcirl::Chooser made(const rcirl::Reward& reward) {
  rcirl::Chooser chooser;
  CHECK_TEXT(rcirl::chooser(reward, {}, &chooser).message(), "");
  return chooser;
}

rcirl::Chooser usual() {
  return made(loaded(likes_speed().file()));
}

// A straight road; the ego is 4 m by 2 m, drives at 10 m/s, and a car stands 40 m ahead.
rcirl::Scene road() {
  rcirl::Scene scene;
  scene.ego.v = 10.0f;
  scene.ego.length = 4.0f;
  scene.ego.width = 2.0f;
  scene.path.speed_limit.fill(15.0f);
  rcirl::Obstacle box;
  box.kind = rcirl::ObstacleKind::kVehicle;
  box.s_lower.fill(38.0f);
  box.s_upper.fill(42.0f);
  box.l_lower.fill(-1.0f);
  box.l_upper.fill(1.0f);
  box.valid.fill(1);
  scene.obstacles = {box};
  return scene;
}

// Braking with 0.05 k m/s^2 until rest: [K, T] m.
std::vector<float> braking(std::size_t count = kCount) {
  std::vector<float> s;
  for (std::size_t k = 0; k < count; ++k) {
    const float b = 0.05f * static_cast<float>(k);
    for (std::size_t t = 0; t < rcirl::kTimes; ++t) {
      const float time = std::min(kDt * static_cast<float>(t), b > 0.0f ? 10.0f / b : 9.0f);
      s.push_back(10.0f * time - 0.5f * b * time * time);
    }
  }
  return s;
}

void test_the_best_admissible_candidate_is_chosen() {
  rcirl::Chooser chooser = usual();
  const std::vector<float> s = braking();
  const rcirl::Choice choice = chooser.choose(road(), {s.data(), nullptr, kCount});
  CHECK(choice.found() && chooser.why().empty());
  CHECK(rcirl::best(chooser.values().data(), kCount) == 0);  // that hits the car
  CHECK_TEXT(text(chooser.rulings()[0]), "hits obstacles[0] after 3.29 s");
  CHECK(chooser.rulings()[choice.best].admissible());
  CHECK(!chooser.rulings()[choice.best - 1].admissible());
  std::vector<std::uint8_t> may;
  for (const rcirl::Ruling& ruling : chooser.rulings()) may.push_back(ruling.admissible());
  CHECK(rcirl::best(chooser.values().data(), kCount, may.data()) == choice.best);
}

void test_what_cannot_be_driven_is_not_chosen() {
  rcirl::Chooser chooser = usual();
  const std::vector<float> s = braking();
  const std::size_t best = chooser.choose(road(), {s.data(), nullptr, kCount}).best;
  std::vector<std::uint8_t> feasible(kCount, 1);
  feasible[best] = 0;
  const rcirl::Candidates given = {s.data(), nullptr, kCount, feasible.data()};
  CHECK(chooser.choose(road(), given).best == best + 1);
  CHECK_TEXT(text(chooser.rulings()[best]), "is not feasible");
}

void test_none_is_chosen_with_a_reason() {
  rcirl::Chooser chooser = usual(), none;
  const std::vector<float> s = braking(3), l(s.size(), 0.0f);
  rcirl::Scene scene = road();
  CHECK(chooser.choose(scene, {s.data(), nullptr, 3}).best == 3);
  CHECK_TEXT(chooser.why(),
             "none of 3 candidates is admissible: candidate 0 hits obstacles[0] after 3.29 s");
  CHECK(chooser.choose(scene, {nullptr, nullptr, 0}).best == 0);
  CHECK_TEXT(chooser.why(), "none of 0 candidates is admissible");
  CHECK(!chooser.choose(scene, {s.data(), l.data(), 3}).found());
  CHECK_TEXT(chooser.why(),
             "scene: path.road_left, path.road_right: None: expected edges, for candidates.l");
  scene.path.kappa[5] = kNan;
  CHECK(!chooser.choose(scene, {s.data(), nullptr, 3}).found());
  CHECK_TEXT(chooser.why(),
             "scene: a number is missing or out of range: expected what rcirl::check accepts");
  CHECK(!none.choose(road(), {s.data(), nullptr, 3}).found());
  CHECK_TEXT(none.why(), "chooser: no reward: expected one that rcirl::chooser made");
}

void test_a_candidate_that_is_not_finite_is_refused_alone() {
  rcirl::Chooser chooser = usual();
  std::vector<float> s = braking();
  const std::size_t best = chooser.choose(road(), {s.data(), nullptr, kCount}).best;
  s[best * rcirl::kTimes + 5] = kNan;
  CHECK(chooser.choose(road(), {s.data(), nullptr, kCount}).best == best + 1);
  CHECK_TEXT(text(chooser.rulings()[best]), "has a number that is not finite, or its scene has");
  CHECK(std::isinf(chooser.values()[best]));
}

void test_numbers_that_are_not_there_are_not_read() {
  rcirl::Chooser chooser = usual();
  const std::vector<float> s = braking();
  rcirl::Scene scene = road();
  const std::size_t best = chooser.choose(scene, {s.data(), nullptr, kCount}).best;
  rcirl::Obstacle late = scene.obstacles[0];  // seen from the fourth time on
  for (std::size_t t = 0; t < 3; ++t) {
    late.valid[t] = 0;
    late.s_lower[t] = late.s_upper[t] = late.speed[t] = kNan;
  }
  scene.obstacles = {late};
  CHECK(chooser.choose(scene, {s.data(), nullptr, kCount}).best == best);
}

void test_choosing_allocates_nothing_the_second_time() {
  rcirl::Chooser chooser = usual();
  const std::vector<float> s = braking();
  const rcirl::Scene scene = road();
  chooser.choose(scene, {s.data(), nullptr, kCount});
  const long before = allocations;
  const std::size_t best = chooser.choose(scene, {s.data(), nullptr, kCount}).best;
  const std::size_t few = chooser.choose(scene, {s.data(), nullptr, 3}).best;
  const long after = allocations;  // a check allocates its text
  CHECK(after == before && before > 0 && best < kCount && few == 3);
}

}  // namespace

int main() {
  test_the_best_admissible_candidate_is_chosen();
  test_what_cannot_be_driven_is_not_chosen();
  test_none_is_chosen_with_a_reason();
  test_a_candidate_that_is_not_finite_is_refused_alone();
  test_numbers_that_are_not_there_are_not_read();
  test_choosing_allocates_nothing_the_second_time();
  return failures == 0 ? 0 : 1;
}
