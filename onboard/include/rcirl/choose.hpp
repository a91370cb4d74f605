// The choice among a planner's own candidates: filter, value, prior cost, in one call.
//
//   rcirl::Chooser chooser;                                            // one for each thread
//   rcirl::Status status = rcirl::chooser(reward, {}, &chooser);       // once
//   const rcirl::Choice choice = chooser.choose(scene, {s, l, count}, own);
//   if (!choice.found()) brake(chooser.why());                         // one line on why
//   chooser.values()[k], rcirl::text(chooser.rulings()[k])             // of every candidate
//
// A value says nothing of safety: a reward was trained to rank what its safety filter lets
// through. So the filter comes first (rcirl/safety.hpp); of what is left, the highest value
// wins. The same in Python: `rcirl_jax/export/own_planner/choose.py`.
//
// Choosing throws nothing and takes no lock. It allocates only where a call has more
// candidates than every one before.
#ifndef RCIRL_CHOOSE_HPP_
#define RCIRL_CHOOSE_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "rcirl/features.hpp"
#include "rcirl/guard.hpp"
#include "rcirl/reward.hpp"
#include "rcirl/safety.hpp"

namespace rcirl {

struct ChooseOptions {
  SafetyLimits safety;
  // Whether own values choose where a plan is out of distribution. Not with a prior cost,
  // which leaves the choice to them by itself.
  bool guard = false;
  GuardLimits guard_limits;
};

// Why there is a best candidate, or none.
enum class Outcome : std::uint8_t {
  kFound,
  kNoneAdmissible,     // no admissible candidate has a value
  kOutOfDistribution,  // so the guard says, and there are no own values
  kNoOwn,              // the reward has a prior cost, and there are no own values
  kElsewhere,          // a candidate begins elsewhere than the ego
  kApart,              // offsets differ, and the reward was trained along one path
  kBadScene,           // `check` refuses it
  kNoRoad,             // offsets, in a scene without the road's edges
  kNoReward,           // a chooser that was not made
};

struct Choice {
  std::size_t best = 0;  // the admissible candidate of the highest value; K if none
  Outcome outcome = Outcome::kNoReward;
  bool in_distribution = true;  // as the guard says; true without one

  bool found() const { return outcome == Outcome::kFound; }
};

namespace detail {

constexpr float kApartM = 0.25f;  // m beside each other from which candidates differ in l

constexpr float kAtEgoM = 1.0f;   // m from the ego within which candidates have to begin

// Where a candidate begins that does not begin where the ego is; whether there is one.
struct Elsewhere {
  bool found = false, lateral = false;
  std::size_t candidate = 0;
  float at = 0.0f, ego = 0.0f;  // m
};

inline Elsewhere begins_elsewhere(const Ego& ego, const Candidates& candidates) {
  for (const bool lateral : {false, true}) {
    const float* places = lateral ? candidates.l : candidates.s;
    const float here = lateral ? ego.l : ego.s;
    for (std::size_t k = 0; places != nullptr && k < candidates.count; ++k) {
      const float first = places[k * kTimes];
      if (std::abs(first - here) > kAtEgoM) return {true, lateral, k, first, here};
    }
  }
  return {};
}

// The two candidates furthest apart in offsets from the path, and when.
struct Apart {
  float metres = 0.0f, time = 0.0f;
  std::size_t left = 0, right = 0;
};

// The offset of the given path at a station, linear between grid points.
inline float path_offset(const Path& path, float s) {
  const float place = std::max(s / kStationStepM, 0.0f);
  const float held = std::min(place, static_cast<float>(kStations - 1));
  const std::size_t low = std::min(static_cast<std::size_t>(held), kStations - 2);
  const float share = held - static_cast<float>(low);
  return path.l[low] + share * (path.l[low + 1] - path.l[low]);
}

inline Apart furthest_apart(const Path& path, const Candidates& candidates) {
  Apart found;
  for (std::size_t t = 0; t < kTimes; ++t) {
    float least = std::numeric_limits<float>::infinity(), most = -least;
    std::size_t left = 0, right = 0;
    for (std::size_t k = 0; k < candidates.count; ++k) {
      const float s = candidates.s[k * kTimes + t], l = candidates.l[k * kTimes + t];
      if (!std::isfinite(s) || !std::isfinite(l)) continue;
      const float aside = l - path_offset(path, s);
      if (aside > most) most = aside, left = k;
      if (aside < least) least = aside, right = k;
    }
    if (most - least > found.metres) found = {most - least, time_s(t), left, right};
  }
  return found;
}

}  // namespace detail

// Chooses for one reward. Holds the memory of a call, so it belongs to one thread at a time.
class Chooser {
 public:
  // The admissible candidate with the highest value.
  //
  //   own  [K] the planner's own values, its costs negated. A prior cost needs them;
  //        without one, the guard alone uses them. Null: none
  //
  // Ranked by V; with a prior cost by own + gain V; where the guard finds a plan out of
  // distribution, by own alone. Any bits are without harm.
  Choice choose(const Scene& scene, const Candidates& candidates, const float* own = nullptr);

  // Of the last call [K]: what candidates were ranked by, -infinity without a value, and
  // which rule each breaks first.
  const std::vector<float>& values() const { return values_; }
  const std::vector<Ruling>& rulings() const { return rulings_; }

  // Why the last call found none, one line; empty if it found one.
  std::string why() const;

  const Reward& reward() const { return reward_; }

 private:
  friend Status chooser(const Reward&, const ChooseOptions&, Chooser*);

  Outcome judge(const Scene& scene, const Candidates& candidates, const float* own);
  Outcome value(const Scene& scene, std::size_t count, const float* own);

  Reward reward_;
  ChooseOptions options_;
  Guard guard_{Reward()};
  FeatureMap columns_;
  Workspace workspace_;
  std::vector<float> features_, values_;
  std::vector<Ruling> rulings_;
  // of the last call
  Choice choice_;
  Verdict verdict_;
  detail::Apart apart_;
  detail::Elsewhere elsewhere_;
};

// A chooser for a reward, which it copies; or why there is none. A failure leaves `made` as
// it was.
inline Status chooser(const Reward& reward, const ChooseOptions& options, Chooser* made) {
  Chooser built;
  const Status status = feature_map(reward, &built.columns_);
  if (!status.ok()) return status;
  if (options.guard && reward.has_prior_cost()) {
    return Status(reward.file() + ": guard: given: expected none, for it has a prior cost");
  }
  built.reward_ = reward;
  built.options_ = options;
  built.guard_ = Guard(reward, options.guard_limits);
  built.workspace_ = reward.workspace();
  *made = std::move(built);
  return Status();
}

inline Choice Chooser::choose(const Scene& scene, const Candidates& candidates,
                              const float* own) {
  const std::size_t count = candidates.count;
  values_.assign(count, -std::numeric_limits<float>::infinity());
  rulings_.assign(count, Ruling());
  choice_ = Choice();
  choice_.best = count;
  choice_.outcome = judge(scene, candidates, own);
  if (!choice_.found()) return choice_;
  float most = -std::numeric_limits<float>::infinity();
  for (std::size_t k = 0; k < count; ++k) {
    if (!rulings_[k].admissible() || !(values_[k] > most)) continue;
    most = values_[k];
    choice_.best = k;
  }
  if (choice_.best == count) choice_.outcome = Outcome::kNoneAdmissible;
  return choice_;
}

// Fills rulings and values.
inline Outcome Chooser::judge(const Scene& scene, const Candidates& candidates,
                              const float* own) {
  if (columns_.size() == 0) return Outcome::kNoReward;
  const Reason reason = detail::judgeable(scene, candidates);
  if (reason == Reason::kNoNumber) return Outcome::kBadScene;
  if (reason == Reason::kNoRoad) return Outcome::kNoRoad;
  elsewhere_ = detail::begins_elsewhere(scene.ego, candidates);
  if (elsewhere_.found) return Outcome::kElsewhere;
  if (candidates.l != nullptr && reward_.mode() == "speed") {
    apart_ = detail::furthest_apart(scene.path, candidates);
    if (apart_.metres > detail::kApartM) return Outcome::kApart;
  }
  const std::size_t row = kTimes * columns_.size();
  if (features_.size() < candidates.count * row) features_.resize(candidates.count * row);
  const std::uint8_t* feasible = candidates.feasible;
  detail::for_each_block(
      scene, candidates,
      [&](std::size_t first, std::size_t lanes, const detail::Point* x, const bool* known) {
        const std::uint8_t* may = feasible == nullptr ? nullptr : feasible + first;
        columns_.write(scene, lanes, x, known, &features_[first * row]);
        detail::judge(scene, options_.safety, lanes, x, known, may, &rulings_[first]);
      });
  return value(scene, candidates.count, own);
}

inline Outcome Chooser::value(const Scene& scene, std::size_t count, const float* own) {
  const Mask valid = columns_.mask(scene);
  const float* features = features_.data();
  if (reward_.has_prior_cost()) {
    if (own == nullptr) return Outcome::kNoOwn;
    reward_.total(features, count, valid, own, &workspace_, values_.data());
    return Outcome::kFound;
  }
  reward_.score(features, count, valid, &workspace_, values_.data());
  if (!options_.guard || count == 0) return Outcome::kFound;
  verdict_ = guard_.check(features, count, valid);
  choice_.in_distribution = verdict_.in_distribution;
  if (verdict_.in_distribution) return Outcome::kFound;
  if (own == nullptr) return Outcome::kOutOfDistribution;
  std::copy(own, own + count, values_.begin());
  return Outcome::kFound;
}

inline std::string Chooser::why() const {
  char line[96];
  const std::size_t count = values_.size();
  switch (choice_.outcome) {
    case Outcome::kFound: return "";
    case Outcome::kNoneAdmissible: {
      const std::string none = "none of " + std::to_string(count) + " candidates is admissible";
      if (count == 0) return none;
      const std::string first = text(rulings_[0]);
      return none + ": candidate 0 " + (first.empty() ? "has no value" : first);
    }
    case Outcome::kOutOfDistribution:
      std::snprintf(line, sizeof line, "%.0f %% of ", 100.0 * verdict_.share);
      return "out of distribution: " + std::string(line) +
             reward_.features()[verdict_.feature].name + ": no own values to choose by";
    case Outcome::kNoOwn:
      return reward_.file() + ": own: None: expected own values, for it has a prior cost";
    case Outcome::kElsewhere:
      std::snprintf(line, sizeof line, "[%zu, 0]: %.2f m: expected the ego's place, %.2f m",
                    elsewhere_.candidate, static_cast<double>(elsewhere_.at),
                    static_cast<double>(elsewhere_.ego));
      return std::string("scene: candidates.") + (elsewhere_.lateral ? "l" : "s") + line;
    case Outcome::kApart:
      std::snprintf(line, sizeof line, "%zu and %zu are %.2f m apart at %.2f s", apart_.left,
                    apart_.right, static_cast<double>(apart_.metres),
                    static_cast<double>(apart_.time));
      return "scene: candidates.l: " + std::string(line) +
             ": expected no offsets, or equal ones: l was not trained (" + reward_.file() +
             ": mode=speed)";
    case Outcome::kBadScene:
      return "scene: a number is missing or out of range: expected what rcirl::check accepts";
    case Outcome::kNoRoad:
      return "scene: path.road_left, path.road_right: None: expected edges, for candidates.l";
    case Outcome::kNoReward: return "chooser: no reward: expected one that rcirl::chooser made";
  }
  return "";
}

}  // namespace rcirl

#endif  // RCIRL_CHOOSE_HPP_
