// Scores against plain double loops; masks, refused candidates, memory, threads.
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <limits>
#include <string>
#include <thread>
#include <vector>

#include "allocations.hpp"
#include "check.hpp"
#include "files.hpp"
#include "rcirl/guard.hpp"
#include "rcirl/reward.hpp"

namespace {

constexpr float kNone = -std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

rcirl::Reward loaded(const Example& example) {
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::decode(example.file(), "w", &reward).message(), "");
  return reward;
}

bool close(float found, double wanted) {
  return std::abs(static_cast<double>(found) - wanted) <= 1e-5 * std::max(1.0, std::abs(wanted));
}

std::vector<Example> examples() {
  std::vector<Example> all;
  for (const char* activation : {"tanh", "relu", "leaky_relu", "identity"}) {
    for (const bool scene_gating : {false, true}) {
      all.emplace_back(21, 18, std::vector<std::size_t>{15}, activation, scene_gating);
    }
  }
  all.emplace_back(21, 18, std::vector<std::size_t>{}, "identity", false);
  all.emplace_back(21, 18, std::vector<std::size_t>{64}, "tanh", false);
  all.emplace_back(21, 18, std::vector<std::size_t>{32, 16}, "tanh", true);
  all.emplace_back(1, 1, std::vector<std::size_t>{1, 1, 1}, "relu", true);
  all.emplace_back(64, 5, std::vector<std::size_t>{7}, "leaky_relu", false);
  return all;
}

void test_scores_equal_plain_loops() {
  for (const Example& example : examples()) {
    const rcirl::Reward reward = loaded(example);
    rcirl::Workspace workspace = reward.workspace();
    for (const std::size_t count : {0u, 1u, 31u, 32u, 33u, 100u}) {
      const std::vector<float> features = example.inputs(count, 5);
      std::vector<std::uint8_t> valid(count * example.times);
      for (std::size_t i = 0; i < valid.size(); ++i) {
        valid[i] = i % example.times == 0 || (i * 2654435761u >> 7) % 3 > 0;
      }
      for (const int masks : {0, 1, 2}) {
        rcirl::Mask mask;
        if (masks > 0) mask.data = valid.data();
        if (masks > 1) mask.shape = rcirl::Mask::kEach;
        std::vector<float> values(count);
        CHECK(reward.score(features.data(), count, mask, &workspace, values.data()) == 0);
        for (std::size_t k = 0; k < count; ++k) {
          const std::uint8_t* row = valid.data() + (masks > 1 ? k * example.times : 0);
          const float* one = &features[k * example.times * example.features];
          CHECK(close(values[k], example.value(one, masks == 0 ? nullptr : row)));
        }
      }
    }
  }
}

void test_a_candidate_without_a_value_is_refused_alone() {
  for (const Example& example : examples()) {
    const rcirl::Reward reward = loaded(example);
    rcirl::Workspace workspace = reward.workspace();
    const std::size_t count = 40, row = example.times * example.features;
    const std::vector<float> clean = example.inputs(count, 6);
    std::vector<float> features = clean, wanted(count), values(count);
    reward.score(clean.data(), count, {}, &workspace, wanted.data());
    for (std::size_t f = 0; f < example.features; ++f) {
      features[7 * row + row - 1 - f] = kNan;
      CHECK(reward.score(features.data(), count, {}, &workspace, values.data()) == 1);
      for (std::size_t k = 0; k < count; ++k) CHECK(values[k] == (k == 7 ? kNone : wanted[k]));
      features[7 * row + row - 1 - f] = 0.0f;
    }
  }
}

void test_times_that_do_not_count_may_be_anything() {
  for (const bool scene_gating : {false, true}) {
    const Example example(3, 4, {5}, "tanh", scene_gating);
    const rcirl::Reward reward = loaded(example);
    rcirl::Workspace workspace = reward.workspace();
    std::vector<float> features = example.inputs(2, 7);
    const std::vector<std::uint8_t> valid = {1, 1, 0, 1, 1, 0, 1, 1};
    const double first = example.value(&features[0], &valid[0]);
    const double second = example.value(&features[12], &valid[4]);
    for (std::size_t f = 0; f < 3; ++f) {
      features[2 * 3 + f] = kNan;
      features[12 + 1 * 3 + f] = -kNone;
    }
    float values[2];
    CHECK(reward.score(features.data(), 2, {valid.data(), rcirl::Mask::kEach}, &workspace,
                       values) == 0);
    CHECK(close(values[0], first) && close(values[1], second));
    CHECK(reward.score(features.data(), 2, {}, &workspace, values) == 1);
    CHECK(values[0] == kNone && values[1] != kNone);
  }
}

void test_infinite_features_are_clipped() {
  const Example example;
  const rcirl::Reward reward = loaded(example);
  rcirl::Workspace workspace = reward.workspace();
  std::vector<float> features(24, -kNone);
  for (std::size_t i = 12; i < 24; ++i) features[i] = example.upper[i % 3];
  float values[2];
  CHECK(reward.score(features.data(), 2, {}, &workspace, values) == 0);
  CHECK(values[0] == values[1]);
}

void test_masks_that_are_no_masks() {
  for (const bool scene_gating : {false, true}) {
    const Example example(3, 4, {5}, "tanh", scene_gating);
    const rcirl::Reward reward = loaded(example);
    rcirl::Workspace workspace = reward.workspace();
    const std::vector<float> features = example.inputs(3, 8);
    const std::vector<std::uint8_t> valid = {1, 1, 1, 1, 0, 1, 1, 1, 1, 1, 2, 1};
    float values[3];
    const std::size_t refused = reward.score(
        features.data(), 3, {valid.data(), rcirl::Mask::kEach}, &workspace, values);
    CHECK(refused == (scene_gating ? 2u : 1u));
    CHECK(values[0] != kNone && (values[1] == kNone) == scene_gating && values[2] == kNone);
    const std::vector<std::uint8_t> none(4, 0);
    CHECK(reward.score(features.data(), 3, {none.data(), rcirl::Mask::kShared}, &workspace,
                       values) == (scene_gating ? 3u : 0u));
    CHECK(values[2] == (scene_gating ? kNone : 0.0f));
  }
}

void test_without_a_reward_or_with_anothers_workspace() {
  const Example small, wide(3, 4, {500}, "tanh", false);
  const rcirl::Reward reward = loaded(wide);
  const std::vector<float> features = small.inputs(2, 9);
  float values[2];
  rcirl::Workspace none, other = loaded(small).workspace();
  CHECK(reward.score(features.data(), 2, {}, &none, values) == 2);
  CHECK(reward.score(features.data(), 2, {}, &other, values) == 2);
  CHECK(values[0] == kNone && values[1] == kNone);
  rcirl::Workspace workspace = reward.workspace();
  CHECK(reward.score(features.data(), 2, {}, &workspace, values) == 0);
  CHECK(rcirl::Reward().score(features.data(), 2, {}, &workspace, values) == 2);
}

void test_sums_beyond_float32_are_refused() {
  Example example(1, 2, {}, "identity", false);
  example.upper = {3e38f};
  example.location = {0.0f};
  example.scale = {1.0f};
  example.gamma = {1.0f, 1.0f};
  example.kernels = {{1.0f}};
  example.biases = {{0.0f}};
  const rcirl::Reward reward = loaded(example);
  rcirl::Workspace workspace = reward.workspace();
  const float features[] = {3e38f, 3e38f, 3e38f, 0.0f};
  float values[2];
  CHECK(reward.score(features, 2, {}, &workspace, values) == 1);
  CHECK(values[0] == kNone && close(values[1], 3e38));
}

void test_best() {
  const float values[] = {-3.0f, kNone, 2.0f, 2.0f, 1.0f};
  CHECK(rcirl::best(values, 5) == 2);
  CHECK(rcirl::best(values + 1, 1) == 1);
  CHECK(rcirl::best(values, 0) == 0);
}

void test_check_features() {
  const rcirl::Reward reward = loaded(Example());
  const std::string unit = "m/s\u00b2";
  CHECK_TEXT(reward.check_features({"feature0", "feature1", "feature2"}, {"m", unit, unit})
                 .message(),
             "");
  const auto line = [&](std::vector<std::string> names, std::vector<std::string> units) {
    return reward.check_features(names, units).message();
  };
  CHECK_TEXT(line({"feature0", "feature2", "feature1"}, {"m", unit, unit}),
             "w: features[1]: ('feature2', '" + unit + "'): expected ('feature1', '" + unit + "')");
  CHECK_TEXT(line({"feature0", "feature1"}, {"m", unit}),
             "w: features[2]: none: expected ('feature2', '" + unit + "')");
  CHECK_TEXT(line({"feature0", "feature1", "feature2", "x"}, {"m", unit, unit, "m"}),
             "w: features[3]: ('x', 'm'): expected none");
  CHECK_TEXT(line({"feature0", "feature1", "feature2"}, {"ft", unit, unit}),
             "w: features[0]: ('feature0', 'ft'): expected ('feature0', 'm')");
  CHECK_TEXT(line({"feature0", "feature1", "feature2"}, {"m", unit}),
             "w: features[2]: ('feature2', None): expected ('feature2', '" + unit + "')");
}

void test_scoring_allocates_nothing() {
  Example example(21, 18, {32, 16}, "tanh", true);
  example.gain = 0.5;
  const rcirl::Reward reward = loaded(example);
  rcirl::Workspace workspace = reward.workspace();
  const std::vector<float> features = example.inputs(100, 3);
  std::vector<float> values(100);
  const rcirl::Guard guard(reward);
  const long before = allocations;
  reward.score(features.data(), 100, {}, &workspace, values.data());
  reward.total(features.data(), 100, {}, values.data(), &workspace, values.data());
  const double share = guard.check(features.data(), 100, {}).share;
  const std::size_t best = rcirl::best(values.data(), 100);
  const long after = allocations;
  CHECK(best < 100 && before > 0 && after == before && share >= 0.0);
}

void test_threads_share_a_reward() {
  const Example example(21, 18, {15}, "tanh", true);
  const rcirl::Reward reward = loaded(example);
  const std::vector<float> features = example.inputs(64, 4);
  std::vector<float> alone(64);
  rcirl::Workspace workspace = reward.workspace();
  reward.score(features.data(), 64, {}, &workspace, alone.data());
  std::atomic<int> different{0};
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&] {
      rcirl::Workspace own = reward.workspace();
      std::vector<float> values(64);
      for (int round = 0; round < 50; ++round) {
        reward.score(features.data(), 64, {}, &own, values.data());
        different += values != alone;
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  CHECK(different == 0);
}

}  // namespace

int main() {
  test_scores_equal_plain_loops();
  test_a_candidate_without_a_value_is_refused_alone();
  test_times_that_do_not_count_may_be_anything();
  test_infinite_features_are_clipped();
  test_masks_that_are_no_masks();
  test_without_a_reward_or_with_anothers_workspace();
  test_sums_beyond_float32_are_refused();
  test_best();
  test_check_features();
  test_scoring_allocates_nothing();
  test_threads_share_a_reward();
  return failures == 0 ? 0 : 1;
}
