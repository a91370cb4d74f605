// Reader and scorer of `weights.msgpack`, the learned reward, for a planner in C++17.
//
//   rcirl::Reward reward;
//   rcirl::Status status = rcirl::load("weights.msgpack", &reward);
//   if (status.ok()) status = reward.check_features(names, units);
//   if (!status.ok()) { log(status.message()); return; }
//   rcirl::Workspace workspace = reward.workspace();           // one for each thread
//   log(rcirl::describe(reward));                              // what it was trained for
//   reward.score(features, count, {}, &workspace, values);     // [K, T, F] -> [K]
//   std::size_t best = rcirl::best(values, count, admissible); // count: none is usable
//
// A value says nothing of safety. `admissible` [K] comes from a safety filter:
// rcirl/safety.hpp has one, and rcirl/choose.hpp does all of it in one call.
//
// A reward with a prior cost goes on top of the planner's own values: where
// `reward.has_prior_cost()`, call `reward.total(..., own, &workspace, values)`, not `score`.
//
// Headers only, on top of msgpack-c's C headers; compiles with -fno-exceptions and
// -fno-rtti. Loading allocates. Scoring allocates nothing, throws nothing, takes no lock,
// and one reward may be scored by many threads, each with its own workspace.
// The file and the equation: docs/weights_format.md.
#ifndef RCIRL_REWARD_HPP_
#define RCIRL_REWARD_HPP_

#include <sys/stat.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "rcirl/detail/decode.hpp"
#include "rcirl/status.hpp"

namespace rcirl {

// Which times of which trajectories count: bytes of 0 and 1.
struct Mask {
  enum Shape { kShared, kEach };  // [T], the same for all; [K, T]

  const std::uint8_t* data = nullptr;  // null: every time is valid
  Shape shape = kShared;
};

// Scratch memory of `Reward::score` and `total`; belongs to one thread at a time.
class Workspace {
 public:
  Workspace() = default;

 private:
  friend class Reward;
  explicit Workspace(std::size_t lanes) : lanes_(lanes) {}

  std::vector<detail::Lanes> lanes_;
};

// A verified reward. Empty (no features, scores nothing) until it is loaded.
class Reward {
 public:
  const std::string& file() const { return file_; }                  // as it was named
  const std::string& sha256() const { return weights_.sha256; }      // names the reward
  const std::string& preset() const { return weights_.preset; }      // of the features
  const std::vector<Feature>& features() const { return weights_.features; }  // [F]
  const std::vector<float>& times() const { return weights_.times; }          // [T] s

  // What candidates may differ in: "speed", in s(t) along one path, for l was not trained;
  // "path_speed", in l too.
  const std::string& mode() const { return weights_.mode; }

  // Features without effect: the training never saw them vary.
  std::vector<std::string> unsupported() const;

  // Refuses columns that are not the file's, in the file's order and units.
  Status check_features(const std::vector<std::string>& names,
                        const std::vector<std::string>& units) const;

  // Memory for `score`, to be made once for each thread.
  Workspace workspace() const { return Workspace(weights_.network.work_size()); }

  // V of trajectories; higher is better.
  //
  //   features   [K, T, F] raw, in the file's order and units, at `times()`; C order:
  //              feature f of candidate k at time t is features[(k * T + t) * F + f]
  //   valid      which times count; only candidates with the same mask compare
  //   workspace  of this reward
  //   values     [K], written
  //
  // Returns how many candidates were refused. Their value is -infinity: a NaN at a valid
  // time, a mask that is not 0 and 1, a sum beyond float32, or, with scene gating, a first
  // time that is not valid. Infinite features are clipped; at times
  // that are not valid, features may be anything. Without a reward, or with a workspace
  // of another one that is too small, all are refused.
  std::size_t score(const float* features, std::size_t count, Mask valid,
                    Workspace* workspace, float* values) const noexcept;

  // Whether V is made to be added to the value of an incumbent, and of which one.
  bool has_prior_cost() const { return !incumbent().empty(); }
  const std::string& incumbent() const { return weights_.incumbent; }
  double gain() const { return weights_.gain; }  // above 0; 0 without a prior cost

  // V_incumbent + gain V of trajectories, with a prior cost; higher is better.
  //
  // V counts where it knows the scene: at the first time, if that is valid, every feature of
  // `unsupported` is within its scale of its location. Elsewhere the total is V_incumbent.
  //
  //   incumbent  [K] its values (a cost, negated); may be the same memory as `values`
  //
  // The rest as `score`, which refuses the same candidates. Refused are also those without
  // a finite value of the incumbent, and all candidates of a reward without a prior cost.
  std::size_t total(const float* features, std::size_t count, Mask valid,
                    const float* incumbent, Workspace* workspace,
                    float* values) const noexcept;

 private:
  friend Status decode(std::string_view data, const std::string& file, Reward* reward);
  friend class Guard;

  std::string file_;
  detail::Weights weights_;
};

// Reads and verifies the bytes of a file; `file` is their name in
// messages. A failure leaves `reward` as it was.
inline Status decode(std::string_view data, const std::string& file, Reward* reward) {
  Reward read;
  const std::string error = detail::decode(data, &read.weights_);
  if (!error.empty()) return Status(file + ": " + error);
  read.file_ = file;
  *reward = std::move(read);
  return Status();
}

// As `decode`, from a regular file.
inline Status load(const std::string& path, Reward* reward) {
  const auto refuse = [&path](const char* reason) {
    return Status(path + ": path: " + reason + ": expected a file");
  };
  struct stat found;
  if (path.find('\0') != std::string::npos) return refuse("a NUL byte");
  if (stat(path.c_str(), &found) != 0 || !S_ISREG(found.st_mode)) return refuse("no such file");
  std::FILE* stream = std::fopen(path.c_str(), "rb");
  if (stream == nullptr) return refuse(std::strerror(errno));
  // One byte more than allowed: an oversize file is seen, not read.
  const std::uint64_t most = detail::kMaxFileBytes + 1;
  std::vector<char> data(
      static_cast<std::size_t>(std::min(static_cast<std::uint64_t>(found.st_size), most)));
  const std::size_t size =
      data.empty() ? 0 : std::fread(data.data(), 1, data.size(), stream);
  std::fclose(stream);
  return decode(std::string_view(data.data(), size), path, reward);
}

// Index of the largest value among the admissible, [K] bytes of 0 and 1 of a safety filter;
// `count` if no admissible candidate has one. Null: all are admissible.
inline std::size_t best(const float* values, std::size_t count,
                        const std::uint8_t* admissible = nullptr) noexcept {
  std::size_t index = count;
  float most = -std::numeric_limits<float>::infinity();
  for (std::size_t k = 0; k < count; ++k) {
    if (admissible != nullptr && admissible[k] == 0) continue;
    if (values[k] > most) {
      most = values[k];
      index = k;
    }
  }
  return index;
}

inline std::vector<std::string> Reward::unsupported() const {
  std::vector<std::string> names;
  for (std::size_t f = 0; f < features().size(); ++f) {
    if (weights_.network.lower[f] >= weights_.network.upper[f]) names.push_back(features()[f].name);
  }
  return names;
}

// Lines on what the values mean and what they do not, for a log.
inline std::string describe(const Reward& reward) {
  std::string without, prior = "none", last = "0";
  for (const std::string& name : reward.unsupported()) {
    without += (without.empty() ? "" : ", ") + name;
  }
  if (reward.has_prior_cost()) {
    prior = reward.incumbent() + ", gain " + detail::number_text(reward.gain());
  }
  if (!reward.times().empty()) {
    last = detail::number_text(static_cast<double>(reward.times().back()));
  }
  const bool speed = reward.mode() == "speed";
  return "mode: " + reward.mode() + (speed ? ": l was not trained" : ": l was trained") +
         "\nfeatures without effect: " + (without.empty() ? "none" : without) +
         "\nprior cost: " + prior + "\ntimes: " + std::to_string(reward.times().size()) +
         " from 0 to " + last + " s\nsafety: none: filter the candidates before you choose";
}

inline Status Reward::check_features(const std::vector<std::string>& names,
                                     const std::vector<std::string>& units) const {
  const auto quoted = [](const std::vector<std::string>& texts, std::size_t i) {
    return i < texts.size() ? "'" + texts[i] + "'" : std::string("None");
  };
  const std::vector<Feature>& own = features();
  const std::size_t given = std::max(names.size(), units.size());
  for (std::size_t i = 0; i < std::max(given, own.size()); ++i) {
    const bool both = i < own.size() && i < names.size() && i < units.size();
    if (both && names[i] == own[i].name && units[i] == own[i].unit) continue;
    std::string found = "none", wanted = "none";
    if (i < given) found = "(" + quoted(names, i) + ", " + quoted(units, i) + ")";
    if (i < own.size()) wanted = "('" + own[i].name + "', '" + own[i].unit + "')";
    return Status(file_ + ": " + detail::index_text("features", i) + ": " + found +
                  ": expected " + wanted);
  }
  return Status();
}

inline std::size_t Reward::score(const float* features, std::size_t count, Mask valid,
                                 Workspace* workspace, float* values) const noexcept {
  const detail::Network& network = weights_.network;
  constexpr float kNone = -std::numeric_limits<float>::infinity();
  if (network.layers.empty() || workspace->lanes_.size() < network.work_size()) {
    std::fill(values, values + count, kNone);
    return count;
  }
  const std::size_t stride = valid.shape == Mask::kEach ? network.times() : 0;
  detail::score(network, features, count, {valid.data, stride}, workspace->lanes_.data(),
                values);
  return static_cast<std::size_t>(std::count(values, values + count, kNone));
}

inline std::size_t Reward::total(const float* features, std::size_t count, Mask valid,
                                 const float* incumbent, Workspace* workspace,
                                 float* values) const noexcept {
  constexpr float kNone = -std::numeric_limits<float>::infinity();
  if (!has_prior_cost()) {
    std::fill(values, values + count, kNone);
    return count;
  }
  const detail::Network& network = weights_.network;
  const std::size_t row = network.times() * network.features;
  const std::size_t stride = valid.shape == Mask::kEach ? network.times() : 0;
  std::size_t refused = 0;
  for (std::size_t first = 0; first < count; first += detail::kLanes) {
    const std::size_t lanes = std::min(detail::kLanes, count - first);
    float own[detail::kLanes];
    std::copy(incumbent + first, incumbent + first + lanes, own);
    Mask marks = valid;
    if (valid.data != nullptr) marks.data += first * stride;
    score(features + first * row, lanes, marks, workspace, values + first);
    for (std::size_t k = 0; k < lanes; ++k) {
      float& value = values[first + k];
      const bool begins = marks.data == nullptr || marks.data[k * stride] != 0;
      const bool known = !begins || detail::knows(network, features + (first + k) * row);
      const double added = gain() * static_cast<double>(value);
      // a value that was refused stays so, whether it counts or not
      const bool counts = known || std::isinf(value);
      const double sum = static_cast<double>(own[k]) + (counts ? added : 0.0);
      const bool finite = std::abs(sum) <= double{std::numeric_limits<float>::max()};
      value = finite ? static_cast<float>(sum) : kNone;
      refused += !finite;
    }
  }
  return refused;
}

}  // namespace rcirl

#endif  // RCIRL_REWARD_HPP_
