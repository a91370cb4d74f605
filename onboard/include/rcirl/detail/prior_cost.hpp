// How much of V is added to the incumbent's value, by the scene's familiarity.
//
//   gain = low + (high - low) sigmoid(out . tanh(z W + b) + c)
//   z_i  = clip((f_0i - location_i) / scale_i, -5, 5)      f_0: raw, at the first time
//
// Summed in double, so that only a NaN has no gain. Nothing in `gain` allocates.
#ifndef RCIRL_DETAIL_PRIOR_COST_HPP_
#define RCIRL_DETAIL_PRIOR_COST_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

#include "rcirl/detail/checks.hpp"
#include "rcirl/detail/limits.hpp"

namespace rcirl::detail {

struct PriorCost {
  std::string incumbent;               // whose value V is added to; empty: none
  double low = 0.0, high = 0.0;        // gains, 0 <= low <= high
  std::vector<float> location, scale;  // [F]
  std::vector<float> kernel;           // [F, H]
  std::vector<float> bias, out;        // [H]
  float offset = 0.0f;
  std::vector<std::size_t> inputs;     // features that matter: their row of W is not 0
};

// Of one trajectory, `first` [F]; not finite if a feature that matters is a NaN.
inline float gain(const PriorCost& prior, const float* first) {
  const std::size_t units = prior.bias.size();
  double z[kMaxFeatures], sum = static_cast<double>(prior.offset);
  for (const std::size_t f : prior.inputs) {
    const double away = static_cast<double>(first[f]) - static_cast<double>(prior.location[f]);
    const double scales = away / static_cast<double>(prior.scale[f]);
    const double above = scales < -kReach ? -kReach : scales;  // a NaN stays one
    z[f] = above > kReach ? kReach : above;
  }
  for (std::size_t h = 0; h < units; ++h) {
    double x = static_cast<double>(prior.bias[h]);
    for (const std::size_t f : prior.inputs) {
      x += z[f] * static_cast<double>(prior.kernel[f * units + h]);
    }
    sum += static_cast<double>(prior.out[h]) * std::tanh(x);
  }
  return narrow(prior.low + (prior.high - prior.low) / (1.0 + std::exp(-sum)));
}

inline bool decode_prior_cost(Checks& is, const Node& node, std::size_t features,
                              PriorCost* prior) {
  std::vector<const Node*> box, rows;
  Array location, scale, kernel, bias, out, offset;
  if (!(is.map("prior_cost", node, {"incumbent", "low", "high", "familiarity"}, &box) &&
        is.text("prior_cost.incumbent", *box[0], &prior->incumbent) &&
        is.number("prior_cost.low", *box[1], &prior->low) &&
        is.number("prior_cost.high", *box[2], &prior->high))) {
    return false;
  }
  if (prior->low < 0.0) {
    return is.fail("prior_cost.low", number_text(prior->low), "at least 0");
  }
  if (prior->high < prior->low) {
    return is.fail("prior_cost.high", number_text(prior->high),
                   "at least low, " + number_text(prior->low));
  }
  const std::string at = "prior_cost.familiarity";
  if (!(is.map(at, *box[3], {"location", "scale", "kernel", "bias", "out", "offset"}, &rows) &&
        is.array(at + ".location", *rows[0], {features}, &location) &&
        is.array(at + ".scale", *rows[1], {features}, &scale) &&
        is.array(at + ".kernel", *rows[2], {features, {1, kMaxUnits}}, &kernel) &&
        is.every(at + ".scale", scale, "over 0",
                 [](float value, std::size_t) { return value > 0.0f; }))) {
    return false;
  }
  const std::size_t units = kernel.shape[1];
  if (!(is.array(at + ".bias", *rows[3], {units}, &bias) &&
        is.array(at + ".out", *rows[4], {units}, &out) &&
        is.array(at + ".offset", *rows[5], {1}, &offset))) {
    return false;
  }
  for (std::size_t f = 0; f < features; ++f) {
    const auto row = kernel.values.begin() + static_cast<std::ptrdiff_t>(f * units);
    const bool matters = std::any_of(row, row + static_cast<std::ptrdiff_t>(units),
                                     [](float weight) { return std::abs(weight) > 0.0f; });
    if (matters) prior->inputs.push_back(f);
  }
  prior->location = std::move(location.values);
  prior->scale = std::move(scale.values);
  prior->kernel = std::move(kernel.values);
  prior->bias = std::move(bias.values);
  prior->out = std::move(out.values);
  prior->offset = offset.values[0];
  return true;
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_PRIOR_COST_HPP_
