// A reward with a prior cost: what is refused, and V_incumbent + gain V against plain loops.
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "with_prior_cost.hpp"
#include "check.hpp"
#include "rcirl/guard.hpp"
#include "rcirl/reward.hpp"

namespace {

constexpr float kNone = -std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

rcirl::Reward loaded(const std::string& file) {
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::decode(file, "w", &reward).message(), "");
  return reward;
}

bool close(float found, double wanted) {
  return std::abs(static_cast<double>(found) - wanted) <= 1e-5 * std::max(1.0, std::abs(wanted));
}

void test_fields() {
  const WithPriorCost a{Example()};
  const auto is = [&a](const std::string& key, const std::string& bytes,
                       const std::string& wanted) {
    rcirl::Reward reward;
    const rcirl::Status status = rcirl::decode(a.tampered(key, bytes), "w", &reward);
    const std::string found = status.message();
    check(found.find("w: " + wanted) == 0, __FILE__, __LINE__, "found '" + found + "'");
  };
  is("incumbent", pack::natural(1), "prior_cost.incumbent: 1: expected a text of 1 to 64");
  is("incumbent", pack::text(""), "prior_cost.incumbent: : expected a text of 1 to 64");
  is("low", pack::real(-0.5), "prior_cost.low: -0.5: expected at least 0");
  is("low", pack::text("0"), "prior_cost.low: 0: expected a finite number");
  is("high", pack::real(0.05), "prior_cost.high: 0.05: expected at least low, 0.1");
  is("high", pack::real(HUGE_VAL), "prior_cost.high: inf: expected a finite number");
  is("high", pack::natural(2), "samples.gain[0]: ");
  is("location", pack::filled({2}, 1.0f), "prior_cost.familiarity.location.shape: [2]: expected [3]");
  is("scale", pack::filled({3}, 0.0f), "prior_cost.familiarity.scale[0]: 0: expected over 0");
  is("kernel", pack::filled({3, 4097}, 0.0f), "prior_cost.familiarity.kernel.shape: [3, 4097]: expected");
  is("kernel", pack::array({3, 0}, {}), "prior_cost.familiarity.kernel.shape: [3, 0]: expected [3, 1 to");
  is("kernel", pack::filled({3, 5}, 0.0f), "prior_cost.familiarity.bias.shape: [4]: expected [5]");
  is("bias", pack::filled({4}, kNan), "prior_cost.familiarity.bias[0]: nan: expected finite numbers");
  is("out", pack::filled({3}, 0.0f), "prior_cost.familiarity.out.shape: [3]: expected [4]");
  is("offset", pack::filled({2}, 0.0f), "prior_cost.familiarity.offset.shape: [2]: expected [1]");
  is("gain", pack::filled({2}, 1.0f), "samples.gain.shape: [2]: expected [3]");
  is("gain", pack::filled({3}, 9.0f), "samples.gain[0]: 9: expected the gain of the sample");
  is("extra", pack::nil(), "prior_cost.extra: unknown: expected the keys incumbent, low");
}

void test_the_total_equals_plain_loops() {
  for (const bool scene_gating : {false, true}) {
    WithPriorCost a(Example(5, 4, {6}, "tanh", scene_gating));
    const rcirl::Reward reward = loaded(a.file());
    CHECK(reward.has_prior_cost() && reward.incumbent() == "hand-set");
    rcirl::Workspace workspace = reward.workspace();
    for (const std::size_t count : {0u, 1u, 32u, 70u}) {
      const std::vector<float> features = a.example.inputs(count, 5);
      std::vector<std::uint8_t> valid(count * 4);
      for (std::size_t i = 0; i < valid.size(); ++i) valid[i] = i % 4 == 0 || i % 3 > 0;
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
          const double v = a.example.value(one, each ? &valid[k * 4] : nullptr);
          CHECK(close(learned[k], v));
          CHECK(close(values[k], double{own[k]} + a.gain(one) * v));
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
  const WithPriorCost a{Example()};
  const rcirl::Reward reward = loaded(a.file());
  rcirl::Workspace workspace = reward.workspace();
  const std::size_t count = 6, row = 12;
  std::vector<float> features = a.example.inputs(count, 6), values(count);
  std::vector<std::uint8_t> valid(count * 4, 1);
  std::vector<float> own(count, 1.0f);
  features[0 * row + 7] = kNan;   // V has none
  features[1 * row + 1] = kNone;  // clipped, by both
  valid[2 * 4] = 0;               // no first time
  own[3] = kNan;
  own[4] = kNone;
  const rcirl::Mask each{valid.data(), rcirl::Mask::kEach};
  CHECK(reward.total(features.data(), count, each, own.data(), &workspace, values.data()) == 4);
  for (const std::size_t k : {0u, 2u, 3u, 4u}) CHECK(values[k] == kNone);
  CHECK(values[1] != kNone && values[5] != kNone);
  own.assign(count, 3.4e38f);
  WithPriorCost steep{Example()};
  steep.low = steep.high = 1e38;
  const rcirl::Reward much = loaded(steep.file());
  features = a.example.inputs(count, 6);
  std::size_t beyond = 0;
  for (std::size_t k = 0; k < count; ++k) {
    beyond += 3.4e38 + 1e38 * a.example.value(&features[k * row], nullptr) > 3.402823466e38;
  }
  CHECK(beyond > 0 && beyond < count);
  CHECK(much.total(features.data(), count, {}, own.data(), &workspace, values.data()) == beyond);
}

void test_without_a_prior_cost_or_a_workspace() {
  const WithPriorCost a{Example()};
  const rcirl::Reward plain = loaded(a.example.file()), reward = loaded(a.file());
  CHECK(!plain.has_prior_cost() && plain.incumbent().empty());
  rcirl::Workspace workspace = plain.workspace(), none;
  const std::vector<float> features = a.example.inputs(2, 9), own = {1.0f, 2.0f};
  float values[2];
  CHECK(plain.total(features.data(), 2, {}, own.data(), &workspace, values) == 2);
  CHECK(values[0] == kNone && values[1] == kNone);
  CHECK(reward.total(features.data(), 2, {}, own.data(), &none, values) == 2);
  CHECK(values[0] == kNone && values[1] == kNone);
  CHECK(rcirl::Reward().total(features.data(), 2, {}, own.data(), &workspace, values) == 2);
}

void test_the_guard_judges_the_features_of_v() {
  const WithPriorCost a{Example()};
  const rcirl::Reward reward = loaded(a.file());
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
