// Is a plan like what the reward was trained on? docs/guard.md has the rule.
//
//   rcirl::Guard guard(reward);                                   // once; copies the ranges
//   rcirl::Verdict verdict = guard.check(features, count, mask);  // all candidates of a plan
//   if (!verdict.in_distribution) best = the incumbent's choice;
//   reward.features()[verdict.feature].name                       // what departs most
//
// Nothing here allocates, throws or takes a lock.
#ifndef RCIRL_GUARD_HPP_
#define RCIRL_GUARD_HPP_

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "rcirl/reward.hpp"

namespace rcirl {

// How far a plan may depart.
struct GuardLimits {
  double margin = 0.25;  // scales by which a recorded range is widened on each side
  double share = 0.25;   // largest share of a feature's entries that may lie outside
};

struct Verdict {
  bool in_distribution = false;
  // One with an entry that is not finite, if any; of those the one with the largest share;
  // the first of equals.
  std::size_t feature = 0;
  double share = 1.0;  // of its entries, outside
};

class Guard {
 public:
  explicit Guard(const Reward& reward, const GuardLimits& limits = GuardLimits())
      : features_(reward.features().size()),
        times_(reward.times().size()),
        limit_(limits.share) {
    const detail::Network& network = reward.weights_.network;
    const std::vector<float>& seen = reward.weights_.training_range;
    for (std::size_t f = 0; f < features_; ++f) {
      const double scale = static_cast<double>(network.scale[f]);
      const double first = static_cast<double>(seen[f]), margin = limits.margin * scale;
      const double last = static_cast<double>(seen[f + features_]);
      // a value at its cap may lie anywhere beyond; what never varied has no cap
      const bool capped = network.lower[f] < network.upper[f];
      const bool open_below = capped && detail::narrow(first) <= network.lower[f];
      const bool open_above = capped && detail::narrow(last) >= network.upper[f];
      low_[f] = open_below ? -kInfinity : detail::narrow(first - margin);
      high_[f] = open_above ? kInfinity : detail::narrow(last + margin);
    }
  }

  // The verdict on one plan.
  //
  //   features  [K, T, F] raw features of all its candidates, as in `Reward::score`
  //   valid     which times count; a byte that is not 0 counts
  //
  // Without any entry, or any reward, nothing is known: out of distribution.
  Verdict check(const float* features, std::size_t count, Mask valid) const noexcept {
    std::uint64_t outside[detail::kMaxFeatures] = {}, entries = 0;
    bool unknown[detail::kMaxFeatures] = {};
    const std::size_t stride = valid.shape == Mask::kEach ? times_ : 0;
    for (std::size_t k = 0; k < count; ++k) {
      for (std::size_t t = 0; t < times_; ++t) {
        if (valid.data != nullptr && valid.data[k * stride + t] == 0) continue;
        ++entries;
        const float* row = features + (k * times_ + t) * features_;
        for (std::size_t f = 0; f < features_; ++f) {
          const bool finite = std::isfinite(row[f]);
          unknown[f] |= !finite;
          outside[f] += !(finite && row[f] >= low_[f] && row[f] <= high_[f]);
        }
      }
    }
    Verdict verdict;
    if (entries == 0 || features_ == 0) return verdict;
    double most = -1.0;
    bool any_unknown = false;
    for (std::size_t f = 0; f < features_; ++f) {
      const double share = static_cast<double>(outside[f]) / static_cast<double>(entries);
      const double rank = unknown[f] ? share + 2.0 : share;
      any_unknown |= unknown[f];
      if (rank > most) {
        most = rank;
        verdict.feature = f;
        verdict.share = share;
      }
    }
    verdict.in_distribution = !any_unknown && verdict.share <= limit_;
    return verdict;
  }

 private:
  static constexpr float kInfinity = std::numeric_limits<float>::infinity();

  std::size_t features_, times_;
  double limit_;
  float low_[detail::kMaxFeatures] = {}, high_[detail::kMaxFeatures] = {};
};

}  // namespace rcirl

#endif  // RCIRL_GUARD_HPP_
