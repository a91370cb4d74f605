// The guard: what is flagged and what is not; test_score.cpp counts its allocations.
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "check.hpp"
#include "files.hpp"
#include "rcirl/guard.hpp"

namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr std::size_t kCount = 8;

// Features lie in [-1.5, 1.25], have location 0 and scale 1; seen in [-0.5, 0.5].
Example plain() {
  Example example(3, 4, {5}, "tanh", false);
  example.location = {0.0f, 0.0f, 0.0f};
  example.scale = {1.0f, 1.0f, 1.0f};
  return example;
}

std::string with_seen(const Example& example,
                      const std::vector<float>& seen = {-0.5f, -0.5f, -0.5f, 0.5f, 0.5f, 0.5f}) {
  auto fields = example.body();
  for (auto& field : fields) {
    if (field.first == "training_range") field.second = pack::array({2, 3}, seen);
  }
  return pack::sealed(pack::map(fields));
}

rcirl::Reward loaded(const std::string& file) {
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::decode(file, "w", &reward).message(), "");
  return reward;
}

std::vector<float> filled(float value) { return std::vector<float>(kCount * 4 * 3, value); }

void test_ranges_are_widened_by_the_margin() {
  const rcirl::Reward reward = loaded(with_seen(plain()));
  const rcirl::Guard guard(reward);
  for (const float inside : {0.0f, -0.75f, 0.75f}) {
    const rcirl::Verdict found = guard.check(filled(inside).data(), kCount, {});
    CHECK(found.in_distribution && found.share == 0.0 && found.feature == 0);
  }
  for (const float outside : {-0.76f, 0.76f, 9.0f}) {
    const rcirl::Verdict found = guard.check(filled(outside).data(), kCount, {});
    CHECK(!found.in_distribution && found.share == 1.0);
  }
  const rcirl::Guard wide(reward, {1.0, 0.25});
  CHECK(wide.check(filled(-1.5f).data(), kCount, {}).in_distribution);
}

void test_the_share_of_one_feature_decides() {
  const rcirl::Guard guard(loaded(with_seen(plain())));
  std::vector<float> features = filled(0.0f);
  for (std::size_t i = 0; i < 8; ++i) features[3 * i + 1] = 1.0f;  // 8 of 32 entries
  rcirl::Verdict found = guard.check(features.data(), kCount, {});
  CHECK(found.in_distribution && found.feature == 1 && found.share == 0.25);
  features[3 * 8 + 1] = 1.0f;
  found = guard.check(features.data(), kCount, {});
  CHECK(!found.in_distribution && found.feature == 1 && found.share == 9.0 / 32.0);
}

// Whether a plan with one number in one column is in distribution.
bool fine(const rcirl::Guard& guard, std::size_t feature, float value) {
  std::vector<float> features = filled(0.0f);
  for (std::size_t i = feature; i < features.size(); i += 3) features[i] = value;
  return guard.check(features.data(), kCount, {}).in_distribution;
}

void test_a_side_is_open_where_training_reached_the_limit() {
  const rcirl::Guard guard(loaded(with_seen(plain(), {-1.5f, -0.5f, -1.6f, 0.5f, 1.25f, 1.3f})));
  CHECK(fine(guard, 0, -1e9f) && !fine(guard, 0, 1e9f));
  CHECK(!fine(guard, 1, -1e9f) && fine(guard, 1, 1e9f));
  CHECK(fine(guard, 2, -1e9f) && fine(guard, 2, 1e9f));
}

// Range and margin cover [-1.5, 1.25], all that the network is given.
void test_beyond_a_range_that_training_did_not_fill_is_outside() {
  const rcirl::Guard guard(loaded(with_seen(plain(), {-1.4f, -1.4f, -1.4f, 1.2f, 1.2f, 1.2f})));
  for (const float inside : {-1.6f, 0.0f, 1.4f}) CHECK(fine(guard, 1, inside));
  for (const float outside : {-1e9f, -1.7f, 1.5f, 1e9f}) CHECK(!fine(guard, 1, outside));
}

void test_not_finite_at_a_valid_time_is_out() {
  const rcirl::Reward narrow = loaded(with_seen(plain()));
  const rcirl::Reward open = loaded(with_seen(plain(), {-2.f, -2.f, -2.f, 2.f, 2.f, 2.f}));
  for (const rcirl::Reward* reward : {&narrow, &open}) {
    const rcirl::Guard guard(*reward);
    for (const float value : {kNan, kInfinity, -kInfinity}) {
      std::vector<float> features = filled(0.0f);
      features[(3 * 4 + 2) * 3 + 2] = value;  // candidate 3, time 2
      rcirl::Verdict found = guard.check(features.data(), kCount, {});
      CHECK(!found.in_distribution && found.feature == 2 && found.share == 1.0 / 32.0);
      const std::vector<std::uint8_t> valid = {1, 1, 0, 1};
      found = guard.check(features.data(), kCount, {valid.data(), rcirl::Mask::kShared});
      CHECK(found.in_distribution && found.share == 0.0);
    }
  }
}

void test_nothing_known_is_out() {
  const rcirl::Guard guard(loaded(with_seen(plain())));
  const std::vector<std::uint8_t> none(4, 0);
  CHECK(!guard.check(filled(0.0f).data(), kCount, {none.data(), rcirl::Mask::kShared})
             .in_distribution);
  CHECK(!guard.check(nullptr, 0, {}).in_distribution);
  CHECK(!rcirl::Guard(rcirl::Reward()).check(nullptr, 0, {}).in_distribution);
}

}  // namespace

int main() {
  test_ranges_are_widened_by_the_margin();
  test_the_share_of_one_feature_decides();
  test_a_side_is_open_where_training_reached_the_limit();
  test_beyond_a_range_that_training_did_not_fill_is_outside();
  test_not_finite_at_a_valid_time_is_out();
  test_nothing_known_is_out();
  return failures == 0 ? 0 : 1;
}
