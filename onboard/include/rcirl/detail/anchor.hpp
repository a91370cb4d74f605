// How much of V is added to the incumbent's value (schema version 4).
//
//   gain = low + (high - low) sigmoid(out . tanh(z W + b) + c)
//   z_i  = clip((f_0i - location_i) / scale_i, -5, 5)      f_0: raw, at the first time
//
// Summed in double, so that only a NaN has no gain. Nothing in `gain` allocates.
#ifndef RCIRL_DETAIL_ANCHOR_HPP_
#define RCIRL_DETAIL_ANCHOR_HPP_

#include <cmath>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

#include "rcirl/detail/checks.hpp"
#include "rcirl/detail/limits.hpp"

namespace rcirl::detail {

struct Anchor {
  std::string incumbent;               // whose value V is added to; empty: no anchor
  double low = 0.0, high = 0.0;        // gains, 0 <= low <= high
  std::vector<float> location, scale;  // [F]
  std::vector<float> kernel;           // [F, H]
  std::vector<float> bias, out;        // [H]
  float offset = 0.0f;
  std::vector<std::size_t> inputs;     // features that matter: their row of W is not 0
};

// Of one trajectory, `first` [F]; not finite if a feature that matters is a NaN.
inline float gain(const Anchor& anchor, const float* first) {
  const std::size_t units = anchor.bias.size();
  double z[kMaxFeatures], sum = static_cast<double>(anchor.offset);
  for (const std::size_t f : anchor.inputs) {
    const double away = static_cast<double>(first[f]) - static_cast<double>(anchor.location[f]);
    const double scales = away / static_cast<double>(anchor.scale[f]);
    const double above = scales < -kReach ? -kReach : scales;  // a NaN stays one
    z[f] = above > kReach ? kReach : above;
  }
  for (std::size_t h = 0; h < units; ++h) {
    double x = static_cast<double>(anchor.bias[h]);
    for (const std::size_t f : anchor.inputs) {
      x += z[f] * static_cast<double>(anchor.kernel[f * units + h]);
    }
    sum += static_cast<double>(anchor.out[h]) * std::tanh(x);
  }
  return narrow(anchor.low + (anchor.high - anchor.low) / (1.0 + std::exp(-sum)));
}

// The body's `anchor`; `gains` are those of the samples, still to be compared.
inline bool decode_anchor(Checks& is, const Node& node, std::size_t features,
                          Anchor* anchor, const Node** gains) {
  std::vector<const Node*> box;
  Array location, scale, kernel, bias, out, offset;
  if (!(is.map("anchor", node,
               {"incumbent", "low", "high", "location", "scale", "kernel", "bias", "out",
                "offset", "gain"},
               &box) &&
        is.text("anchor.incumbent", *box[0], &anchor->incumbent) &&
        is.number("anchor.low", *box[1], &anchor->low) &&
        is.number("anchor.high", *box[2], &anchor->high))) {
    return false;
  }
  if (anchor->low < 0.0) return is.fail("anchor.low", number_text(anchor->low), "at least 0");
  if (anchor->high < anchor->low) {
    return is.fail("anchor.high", number_text(anchor->high),
                   "at least low, " + number_text(anchor->low));
  }
  if (!(is.array("anchor.location", *box[3], {features}, &location) &&
        is.array("anchor.scale", *box[4], {features}, &scale) &&
        is.every("anchor.scale", scale, "over 0",
                 [](float value, std::size_t) { return value > 0.0f; }) &&
        is.array("anchor.kernel", *box[5], {features, {1, kMaxUnits}}, &kernel))) {
    return false;
  }
  const std::size_t units = kernel.shape[1];
  if (!(is.array("anchor.bias", *box[6], {units}, &bias) &&
        is.array("anchor.out", *box[7], {units}, &out) &&
        is.array("anchor.offset", *box[8], {1}, &offset))) {
    return false;
  }
  for (std::size_t i = 0; i < kernel.values.size(); ++i) {
    const std::size_t f = i / units;
    const bool known = !anchor->inputs.empty() && anchor->inputs.back() == f;
    if (kernel.values[i] != 0.0f && !known) anchor->inputs.push_back(f);
  }
  anchor->location = std::move(location.values);
  anchor->scale = std::move(scale.values);
  anchor->kernel = std::move(kernel.values);
  anchor->bias = std::move(bias.values);
  anchor->out = std::move(out.values);
  anchor->offset = offset.values[0];
  *gains = box[9];
  return true;
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_ANCHOR_HPP_
