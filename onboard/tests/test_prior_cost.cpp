// A reward with a prior cost: what is refused, and V_incumbent + gain V against plain loops.
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "check.hpp"
#include "files.hpp"
#include "rcirl/guard.hpp"
#include "rcirl/reward.hpp"

namespace {

constexpr float kNone = -std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

// On top of "hand-set".
Example gained(double gain = 0.75, Example example = Example()) {
  example.gain = gain;
  return example;
}

rcirl::Reward loaded(const Example& example) {
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::decode(example.file(), "w", &reward).message(), "");
  return reward;
}

bool close(float found, double wanted) {
  return std::abs(static_cast<double>(found) - wanted) <= 1e-5 * std::max(1.0, std::abs(wanted));
}

void test_fields() {
  const auto is = [](const std::string& bytes, const std::string& wanted) {
    rcirl::Reward reward;
    const rcirl::Status status =
        rcirl::decode(Example().tampered("prior_cost", bytes), "w", &reward);
    const std::string found = status.message();
    check(found.find("w: prior_cost" + wanted) == 0, __FILE__, __LINE__, "found '" + found + "'");
  };
  const std::string one = pack::real(1.0), name = pack::text("hand-set");
  const auto prior = Example::prior_cost;
  is(pack::list({}), ": list of 0: expected a map");
  is(prior(one, pack::natural(1)), ".incumbent: 1: expected a text of 1 to 64");
  is(prior(one, pack::text("")), ".incumbent: : expected a text of 1 to 64");
  is(prior(one, pack::text(std::string(65, 'x'))), ".incumbent: xxx");
  is(prior(pack::real(-0.5), name), ".gain: -0.5: expected above 0");
  is(prior(pack::natural(0), name), ".gain: 0: expected above 0");
  is(prior(pack::text("1"), name), ".gain: 1: expected a finite number");
  is(prior(pack::real(HUGE_VAL), name), ".gain: inf: expected a finite number");
  is(pack::map({{"incumbent", name}}), ".gain: missing: expected the keys incumbent, gain");
  is(pack::map({{"incumbent", name}, {"gain", one}, {"low", one}}),
     ".low: unknown: expected the keys incumbent, gain");
}

void test_the_total_equals_plain_loops() {
  for (const bool scene_gating : {false, true}) {
    const Example a = gained(0.75, Example(5, 4, {6}, "tanh", scene_gating));
    const rcirl::Reward reward = loaded(a);
    CHECK(reward.has_prior_cost() && reward.incumbent() == "hand-set");
    CHECK(reward.gain() == 0.75);
    CHECK(rcirl::describe(reward).find("\nprior cost: hand-set, gain 0.75\n") != std::string::npos);
    rcirl::Workspace workspace = reward.workspace();
    for (const std::size_t count : {0u, 1u, 32u, 70u}) {
      const std::vector<float> features = a.inputs(count, 5);
      std::vector<std::uint8_t> valid(count * 4);
      for (std::size_t i = 0; i < valid.size(); ++i) {
        valid[i] = (scene_gating && i % 4 == 0) || i % 3 > 0;
      }
      std::vector<float> own(count), values(count), learned(count);
      for (std::size_t k = 0; k < count; ++k) own[k] = static_cast<float>(k) - 20.0f;
      for (const bool each : {false, true}) {
        const rcirl::Mask mask = each ? rcirl::Mask{valid.data(), rcirl::Mask::kEach}
                                      : rcirl::Mask{};
        CHECK(reward.total(features.data(), count, mask, own.data(), &workspace,
                           values.data()) == 0);
        reward.score(features.data(), count, mask, &workspace, learned.data());
        for (std::size_t k = 0; k < count; ++k) {
          const float* one = &features[k * 20];
          const double v = a.value(one, each ? &valid[k * 4] : nullptr);
          CHECK(close(learned[k], v));
          CHECK(close(values[k], double{own[k]} + 0.75 * v));
        }
        std::vector<float> same = own;
        CHECK(reward.total(features.data(), count, mask, same.data(), &workspace,
                           same.data()) == 0);
        CHECK(same == values);
      }
    }
  }
}

void test_a_candidate_without_a_total_is_refused_alone() {
  const Example a = gained();
  const rcirl::Reward reward = loaded(a);
  rcirl::Workspace workspace = reward.workspace();
  const std::size_t count = 6, row = 12;
  std::vector<float> features = a.inputs(count, 6), values(count);
  std::vector<std::uint8_t> valid(count * 4, 1);
  std::vector<float> own(count, 1.0f);
  features[0 * row + 7] = kNan;   // V has none
  features[1 * row + 1] = kNone;  // clipped
  valid[2 * 4] = 0;               // one time less in the sum
  own[3] = kNan;
  own[4] = kNone;
  const rcirl::Mask each{valid.data(), rcirl::Mask::kEach};
  CHECK(reward.total(features.data(), count, each, own.data(), &workspace, values.data()) == 3);
  for (std::size_t k = 0; k < count; ++k) {
    CHECK((values[k] == kNone) == (k == 0 || k == 3 || k == 4));
  }
  own.assign(count, 3.4e38f);
  const rcirl::Reward much = loaded(gained(1e38));
  features = a.inputs(count, 6);
  std::size_t beyond = 0;
  for (std::size_t k = 0; k < count; ++k) {
    beyond += 3.4e38 + 1e38 * a.value(&features[k * row], nullptr) > 3.402823466e38;
  }
  CHECK(beyond > 0 && beyond < count);
  CHECK(much.total(features.data(), count, {}, own.data(), &workspace, values.data()) == beyond);
}

void test_without_a_prior_cost_or_a_workspace() {
  const Example a;
  const rcirl::Reward plain = loaded(a), reward = loaded(gained());
  CHECK(!plain.has_prior_cost() && plain.incumbent().empty());
  rcirl::Workspace workspace = plain.workspace(), none;
  const std::vector<float> features = a.inputs(2, 9), own = {1.0f, 2.0f};
  float values[2];
  CHECK(plain.total(features.data(), 2, {}, own.data(), &workspace, values) == 2);
  CHECK(values[0] == kNone && values[1] == kNone);
  CHECK(reward.total(features.data(), 2, {}, own.data(), &none, values) == 2);
  CHECK(values[0] == kNone && values[1] == kNone);
  CHECK(rcirl::Reward().total(features.data(), 2, {}, own.data(), &workspace, values) == 2);
}

void test_the_guard_judges_the_features_of_v() {
  const Example a = gained();
  const rcirl::Reward reward = loaded(a);
  const std::vector<float> inside(12, 0.0f), beyond(12, 1e9f);
  CHECK(rcirl::Guard(reward).check(inside.data(), 1, {}).in_distribution);
  CHECK(!rcirl::Guard(reward).check(beyond.data(), 1, {}).in_distribution);
}

}  // namespace

int main() {
  test_fields();
  test_the_total_equals_plain_loops();
  test_a_candidate_without_a_total_is_refused_alone();
  test_without_a_prior_cost_or_a_workspace();
  test_the_guard_judges_the_features_of_v();
  return failures == 0 ? 0 : 1;
}
