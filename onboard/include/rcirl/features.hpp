// The feature map F: a scene and candidates to what a reward reads.
//
//   rcirl::FeatureMap columns;                                     // once
//   rcirl::Status status = rcirl::feature_map(reward, &columns);   // by the file's names
//   if (status.ok()) status = rcirl::check(scene);                 // each planning frame
//   if (!status.ok()) { log(status.message()); return; }
//   columns.compute(scene, {s, l, count}, features);               // [K, T] -> [K, T, F]
//   reward.score(features, count, columns.mask(scene), &workspace, values);
//
// A value says nothing of safety: rcirl/choose.hpp filters, values and chooses in one call.
//
// It computes what `rcirl_jax.features` does, within 1e-5. Computing allocates nothing,
// throws nothing, takes no lock. The structs: rcirl/scene.hpp. The columns:
// docs/features.md. Check your own implementation: onboard/conformance.
#ifndef RCIRL_FEATURES_HPP_
#define RCIRL_FEATURES_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "rcirl/detail/columns.hpp"
#include "rcirl/reward.hpp"
#include "rcirl/scene.hpp"

namespace rcirl {

// K candidates of a scene as positions at the T times.
struct Candidates {
  const float* s = nullptr;  // [K, T] m, stations
  const float* l = nullptr;  // [K, T] m, lateral offsets; null: along the given path
  std::size_t count = 0;     // K
  // [K] 0: the vehicle cannot drive it, which nothing here knows; null: it can drive all
  const std::uint8_t* feasible = nullptr;
};

namespace detail {

// Calls `each(first, lanes, x, known)` for every block of candidates: the first one's
// number, how many, their points [T], and whether each has positions.
template <typename Each>
void for_each_block(const Scene& scene, const Candidates& candidates, const Each& each) {
  const PathTable table = tabulated(scene.path);
  for (std::size_t first = 0; first < candidates.count; first += kLanes) {
    const std::size_t lanes = std::min(kLanes, candidates.count - first);
    Point x[kTimes];
    bool known[kLanes];
    fill_block(candidates.s, candidates.l, first, lanes, x, known);
    complete(scene, table, candidates.l == nullptr, x);
    each(first, lanes, x, known);
  }
}

}  // namespace detail

// F with the columns of a weights file, in its order. Empty until it is made.
class FeatureMap {
 public:
  std::size_t size() const { return columns_.size(); }  // F

  // F of all candidates of a scene.
  //
  //   features  [K, T, F] raw, as `Reward::score` reads them, written
  //
  // Returns how many candidates were refused; all their features are NaN, which `score`
  // refuses too: one with a position that is not finite, and all where the scene is not
  // as `check` wants it. Any bits are without harm.
  std::size_t compute(const Scene& scene, const Candidates& candidates,
                      float* features) const noexcept;

  // Which times of a scene count.
  Mask mask(const Scene& scene) const noexcept {
    static constexpr std::uint8_t kCount[2 * kTimes] = {1, 1, 1, 1, 1, 1, 1, 1, 1,
                                                        1, 1, 1, 1, 1, 1, 1, 1, 1};
    return {kCount + kTimes - std::min(scene.num_valid, kTimes), Mask::kShared};
  }

 private:
  friend class Chooser;

  // F of a block of candidates; returns how many were refused.
  std::size_t write(const Scene& scene, std::size_t lanes, const detail::Point* x,
                    const bool* known, float* features) const noexcept;

  friend Status feature_map(const std::vector<Feature>&, const std::string&, FeatureMap*);

  std::vector<detail::Column> columns_;  // [F]
};

// F by names and units; `file` is where they stand, in messages.
inline Status feature_map(const std::vector<Feature>& features, const std::string& file,
                          FeatureMap* map) {
  FeatureMap made;
  for (std::size_t f = 0; f < features.size(); ++f) {
    const std::string& name = features[f].name;
    const std::string place = file + ": " + detail::index_text("features", f) + ": " + name;
    std::size_t c = 0;
    while (c < detail::kNumColumns && name != detail::kColumns[c].name) ++c;
    if (c == detail::kNumColumns) {
      return Status(place + ": expected a column of docs/features.md");
    }
    if (features[f].unit != detail::kColumns[c].unit) {
      return Status(place + ": " + features[f].unit + ": expected " + detail::kColumns[c].unit);
    }
    made.columns_.push_back(static_cast<detail::Column>(c));
  }
  *map = made;
  return Status();
}

// F as a reward reads it.
inline Status feature_map(const Reward& reward, FeatureMap* map) {
  const std::vector<float>& times = reward.times();
  bool same = times.size() == kTimes;
  for (std::size_t t = 0; same && t < kTimes; ++t) {
    same = std::abs(times[t] - kHorizonS * static_cast<float>(t) / 17.0f) < 1e-4f;
  }
  if (!same) return Status(reward.file() + ": times: another grid: expected 8 i / 17 s, i = 0 .. 17");
  return feature_map(reward.features(), reward.file(), map);
}

inline std::size_t FeatureMap::compute(const Scene& scene, const Candidates& candidates,
                                       float* features) const noexcept {
  const std::size_t row = kTimes * size();
  constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
  if (!detail::usable(scene)) {
    std::fill(features, features + candidates.count * row, kNan);
    return candidates.count;
  }
  std::size_t refused = 0;
  detail::for_each_block(scene, candidates,
                         [&](std::size_t first, std::size_t lanes, const detail::Point* x,
                             const bool* known) {
                           refused += write(scene, lanes, x, known, features + first * row);
                         });
  return refused;
}

inline std::size_t FeatureMap::write(const Scene& scene, std::size_t lanes,
                                     const detail::Point* x, const bool* known,
                                     float* features) const noexcept {
  const std::size_t row = kTimes * size();
  for (std::size_t t = 0; t < kTimes; ++t) {
    detail::Relations near;
    detail::Lanes columns[detail::kNumColumns];
    detail::relate(scene, x, t, &near);
    detail::fill_columns(scene.ego, t, x[t], near, columns);
    for (std::size_t k = 0; k < lanes; ++k) {
      float* out = features + k * row + t * size();
      for (std::size_t f = 0; f < size(); ++f) out[f] = columns[columns_[f]].at[k];
    }
  }
  std::size_t refused = 0;
  for (std::size_t k = 0; k < lanes; ++k) {
    constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
    if (!known[k]) std::fill(features + k * row, features + (k + 1) * row, kNan);
    refused += !known[k];
  }
  return refused;
}

}  // namespace rcirl

#endif  // RCIRL_FEATURES_HPP_
