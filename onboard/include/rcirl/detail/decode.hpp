// Bytes of a file -> a checked, verified network. docs/weights_format.md is the contract.
#ifndef RCIRL_DETAIL_DECODE_HPP_
#define RCIRL_DETAIL_DECODE_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "rcirl/detail/checks.hpp"
#include "rcirl/detail/limits.hpp"
#include "rcirl/detail/network.hpp"
#include "rcirl/detail/sha256.hpp"
#include "rcirl/detail/tree.hpp"

namespace rcirl {

// One column of the feature matrix, as the planner must deliver it.
struct Feature {
  std::string name;
  std::string unit;         // SI; "1" marks a pure number
  double none_value = 0.0;  // value when nothing of the class is there, in unit
};

namespace detail {

struct Weights {
  std::string sha256;  // of the body; names this reward
  std::string preset;
  std::string mode = "speed";         // or "path_speed": candidates differ in l too
  std::vector<Feature> features;      // [F]
  std::vector<float> times;           // [T] s
  std::vector<float> training_range;  // [2, F] ends of the training's range
  std::string incumbent;              // whose value V is added to; empty: none
  double gain = 0.0;                  // of V on top of it, above 0
  Network network;
};

using Values = std::vector<const Node*>;

inline bool decode_features(Checks& is, const Node& node, std::vector<Feature>* features) {
  Values rows, row;
  if (!is.list("features", node, kMaxFeatures, &rows)) return false;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const std::string at = index_text("features", i);
    Feature feature;
    if (!(is.map(at, *rows[i], {"name", "unit", "none_value"}, &row) &&
          is.text(at + ".name", *row[0], &feature.name) &&
          is.text(at + ".unit", *row[1], &feature.unit))) {
      return false;
    }
    for (const Feature& before : *features) {
      if (before.name == feature.name) {
        return is.fail(at + ".name", feature.name, "a name used once");
      }
    }
    if (!is.number(at + ".none_value", *row[2], &feature.none_value)) return false;
    features->push_back(std::move(feature));
  }
  return true;
}

inline bool decode_normaliser(Checks& is, const Node& node, Network* network) {
  static constexpr const char* kNames[] = {"lower", "upper", "location", "scale"};
  Values boxes;
  Array ranges[4];
  if (!is.map("normaliser", node, {"lower", "upper", "location", "scale"}, &boxes)) {
    return false;
  }
  for (std::size_t i = 0; i < 4; ++i) {
    const std::string field = std::string("normaliser.") + kNames[i];
    if (!is.array(field, *boxes[i], {network->features}, &ranges[i])) return false;
  }
  const std::vector<float>& upper = ranges[1].values;
  if (!(is.every("normaliser.lower", ranges[0], "at most upper",
                 [&](float value, std::size_t i) { return value <= upper[i]; }) &&
        is.every("normaliser.scale", ranges[3], "over 0",
                 [](float value, std::size_t) { return value > 0.0f; }))) {
    return false;
  }
  network->lower = std::move(ranges[0].values);
  network->upper = std::move(ranges[1].values);
  network->location = std::move(ranges[2].values);
  network->scale = std::move(ranges[3].values);
  return true;
}

inline bool decode_times(Checks& is, const Node& node, std::vector<float>* times) {
  Array array;
  if (!is.array("times", node, {{1, kMaxTimes}}, &array)) return false;
  *times = std::move(array.values);
  if (std::abs((*times)[0]) > 0.0f) {
    return is.fail("times[0]", number_text(static_cast<double>((*times)[0])), "0 s first");
  }
  for (std::size_t i = 1; i < times->size(); ++i) {
    if (!((*times)[i] > (*times)[i - 1])) {
      return is.fail(index_text("times", i), number_text(static_cast<double>((*times)[i])),
                     "increasing times");
    }
  }
  return true;
}

inline bool decode_activation(Checks& is, const Node& node, Activation* activation) {
  static constexpr std::string_view kNames[] = {"tanh", "relu", "leaky_relu", "identity"};
  std::string name;
  if (!is.text("activation", node, &name)) return false;
  for (std::size_t i = 0; i < 4; ++i) {
    if (name == kNames[i]) {
      *activation = static_cast<Activation>(i);
      return true;
    }
  }
  return is.fail("activation", name, "one of tanh, relu, leaky_relu, identity");
}

// The chain F -> ... -> 1.
inline bool decode_layers(Checks& is, const Node& node, Network* network) {
  Values rows, row;
  if (!is.list("layers", node, kMaxLayers, &rows)) return false;
  std::size_t width = network->features;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const std::string at = index_text("layers", i);
    Array kernel, bias;
    if (!(is.map(at, *rows[i], {"kernel", "bias"}, &row) &&
          is.array(at + ".kernel", *row[0], {width, {1, kMaxUnits}}, &kernel) &&
          is.array(at + ".bias", *row[1], {kernel.shape[1]}, &bias))) {
      return false;
    }
    Layer layer;
    layer.in = width;
    layer.out = width = kernel.shape[1];
    layer.kernel = std::move(kernel.values);
    layer.bias = std::move(bias.values);
    network->layers.push_back(std::move(layer));
  }
  return width == 1 || is.fail(index_text("layers", rows.size() - 1) + ".kernel",
                               std::to_string(width), "1 output, the reward");
}

inline bool decode_prior_cost(Checks& is, const Node& node, Weights* weights) {
  Values row;
  return is.map("prior_cost", node, {"incumbent", "gain"}, &row) &&
         is.text("prior_cost.incumbent", *row[0], &weights->incumbent) &&
         is.number("prior_cost.gain", *row[1], &weights->gain) &&
         (weights->gain > 0.0 || is.fail("prior_cost.gain", *row[1], "above 0"));
}

inline bool decode_loss(Checks& is, const Node& node) {
  Values loss;
  std::string name;
  double rate;
  return is.map("loss", node, {"name", "leaky_rate"}, &loss) &&
         is.text("loss.name", *loss[0], &name) &&
         (loss[1]->kind == Kind::kNil || is.number("loss.leaky_rate", *loss[1], &rate));
}

// The file's own samples must score as the file says.
inline bool verify(Checks& is, const Node& node, const Network& network) {
  Values found;
  Array value, features, valid;
  if (!(is.map("samples", node, {"features", "valid", "value"}, &found) &&
        is.array("samples.value", *found[2], {{1, kMaxSamples}}, &value))) {
    return false;
  }
  const std::size_t count = value.values.size(), times = network.times();
  if (!(is.array("samples.features", *found[0], {count, times, network.features}, &features) &&
        is.array("samples.valid", *found[1], {count, times}, &valid) &&
        is.every("samples.valid", valid, "0 or 1", [](float v, std::size_t) {
          return std::equal_to<float>()(v, 0.0f) || std::equal_to<float>()(v, 1.0f);
        }))) {
    return false;
  }
  if (!network.scene_gating.empty() &&
      !is.every("samples.valid", valid, "1 at the first time",
                [&](float v, std::size_t i) { return i % times != 0 || v > 0.0f; })) {
    return false;
  }
  std::vector<std::uint8_t> marks(valid.values.begin(), valid.values.end());
  std::vector<Lanes> work(network.work_size());
  std::vector<float> scored(count);
  score(network, features.values.data(), count, {marks.data(), times}, work.data(),
        scored.data());
  for (std::size_t i = 0; i < count; ++i) {
    const double want = static_cast<double>(value.values[i]);
    const double got = static_cast<double>(scored[i]);
    if (!(std::abs(got - want) <= kTolerance * std::max(1.0, std::abs(want)))) {
      return is.fail(index_text("samples", i), "scored " + number_text(got),
                     number_text(want) + " within 1e-05 of max(1, |V|)");
    }
  }
  return true;
}

inline bool decode_seen(Checks& is, const Node& node, std::size_t features, Array* seen) {
  if (!is.array("training_range", node, {2, features}, seen)) return false;
  const std::vector<float>& ends = seen->values;
  return is.every("training_range", *seen, "at most the highest", [&](float value, std::size_t i) {
    return i >= features || value <= ends[i + features];
  });
}

inline bool decode_body(Checks& is, const Node& root, Weights* weights) {
  Network& network = weights->network;
  Values body;
  if (!(is.map("body", root,
               {"preset", "features", "normaliser", "training_range", "times", "gamma", "layers",
                "activation", "leaky_slope", "scene_gating", "prior_cost", "loss", "provenance",
                "samples"},
               &body) &&
        decode_features(is, *body[1], &weights->features))) {
    return false;
  }
  const std::size_t size = network.features = weights->features.size();
  const bool gated = body[9]->kind != Kind::kNil, added = body[10]->kind != Kind::kNil;
  Array scene_gating, training_range, gamma;
  double slope = 0.0;
  if (!(decode_normaliser(is, *body[2], &network) &&
        decode_times(is, *body[4], &weights->times) &&
        decode_activation(is, *body[7], &network.activation) &&
        (!gated || is.array("scene_gating", *body[9], {size, size}, &scene_gating)) &&
        decode_seen(is, *body[3], size, &training_range) && decode_loss(is, *body[11]) &&
        is.text("preset", *body[0], &weights->preset) &&
        is.array("gamma", *body[5], {weights->times.size()}, &gamma) &&
        decode_layers(is, *body[6], &network) &&
        is.number("leaky_slope", *body[8], &slope) &&
        (!added || decode_prior_cost(is, *body[10], weights)) &&
        is.plain("provenance", *body[12], kMaxDepth))) {
    return false;
  }
  const Node* mode = is.find(*body[12], "mode");
  const bool lateral = mode != nullptr && mode->kind == Kind::kText && mode->bytes == "path_speed";
  weights->mode = lateral ? "path_speed" : "speed";
  weights->training_range = std::move(training_range.values);
  network.scene_gating = std::move(scene_gating.values);
  network.gamma = std::move(gamma.values);
  network.leaky_slope = narrow(slope);
  return verify(is, *body[13], network);
}

inline bool decode_outer(Checks& is, const Node& root, Weights* weights,
                         std::string_view* body) {
  const Node* magic = is.find(root, "magic");
  if (magic == nullptr || magic->kind != Kind::kText || magic->bytes != kMagic) {
    return is.fail("magic", "missing or another", "'RCIRLW'");
  }
  const Node* version = is.find(root, "schema_version");
  if (version == nullptr || version->kind != Kind::kUint || version->natural != 1) {
    return is.fail("schema_version", version == nullptr ? Node{} : *version,
                   "1, all this reader supports");
  }
  Values outer;
  if (!is.map("file", root, {"magic", "schema_version", "body", "sha256"}, &outer)) {
    return false;
  }
  const bool has_bytes = outer[2]->kind == Kind::kBytes;
  const std::string found =
      has_bytes ? sha256_hex(outer[2]->bytes.data(), outer[2]->bytes.size()) : "no bytes";
  if (!has_bytes || outer[3]->kind != Kind::kText || outer[3]->bytes != found) {
    return is.fail("sha256", found, show(*outer[3]) + "; the file is damaged");
  }
  weights->sha256 = found;
  *body = outer[2]->bytes;
  return true;
}

// What is wrong with the bytes, "field: value: expected ..."; empty if nothing is.
inline std::string decode(std::string_view data, Weights* weights) {
  const std::string whole = ": expected one whole msgpack map";
  if (data.empty() || data.size() > kMaxFileBytes) {
    return "size: " + std::to_string(data.size()) + " bytes or more: expected 1 to " +
           std::to_string(kMaxFileBytes) + " bytes";
  }
  std::string_view body;
  {
    Tree tree;
    const std::string error = parse(data, &tree);
    if (!error.empty()) return "file: " + error + whole;
    Checks checks(tree);
    if (!decode_outer(checks, tree.at(tree.root), weights, &body)) return checks.error();
  }
  Tree tree;
  const std::string error = parse(body, &tree);
  if (!error.empty()) return "body: " + error + whole;
  Checks checks(tree);
  if (!decode_body(checks, tree.at(tree.root), weights)) return checks.error();
  return {};
}

}  // namespace detail
}  // namespace rcirl

#endif  // RCIRL_DETAIL_DECODE_HPP_
