// An example on top of an incumbent, and its gain in plain double loops.
#ifndef RCIRL_TESTS_WITH_PRIOR_COST_HPP_
#define RCIRL_TESTS_WITH_PRIOR_COST_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "files.hpp"

using Fields = std::vector<std::pair<std::string, std::string>>;

struct WithPriorCost {
  Example example;
  std::size_t units = 4;
  double low = 0.1, high = 1.5;
  std::vector<float> location, scale, kernel, bias, out, offset;

  explicit WithPriorCost(Example e) : example(std::move(e)) {
    std::mt19937 random(11);
    std::normal_distribution<double> draw(0.0, 1.0);
    const auto normal = [&](std::size_t size) {
      std::vector<float> values(size);
      for (float& value : values) value = static_cast<float>(draw(random));
      return values;
    };
    location = normal(example.features);
    scale = std::vector<float>(example.features, 0.5f);
    kernel = normal(example.features * units);
    for (std::size_t h = 0; h < units; ++h) kernel[h] = 0.0f;  // the first does not matter
    bias = normal(units);
    out = normal(units);
    offset = normal(1);
  }

  // Of the first time [F].
  double gain(const float* first) const {
    double sum = double{offset[0]};
    for (std::size_t h = 0; h < units; ++h) {
      double x = double{bias[h]};
      for (std::size_t f = 1; f < example.features; ++f) {
        const double z = (double{first[f]} - double{location[f]}) / double{scale[f]};
        x += std::min(std::max(z, -5.0), 5.0) * double{kernel[f * units + h]};
      }
      sum += double{out[h]} * std::tanh(x);
    }
    return low + (high - low) / (1.0 + std::exp(-sum));
  }

  // Gains of the example's samples [m].
  std::vector<float> gains() const {
    const std::size_t row = example.times * example.features;
    const std::vector<float> raw = example.inputs(example.samples, example.seed + 1);
    std::vector<float> found(example.samples);
    for (std::size_t i = 0; i < found.size(); ++i) {
      found[i] = static_cast<float>(gain(&raw[i * row]));
    }
    return found;
  }

  // The file with one field of the prior cost, or of its familiarity, replaced (added to
  // the prior cost if it is new).
  std::string tampered(const std::string& key = "", const std::string& bytes = "") const {
    const std::size_t size = example.features;
    Fields familiarity = {{"location", pack::array({size}, location)},
                          {"scale", pack::array({size}, scale)},
                          {"kernel", pack::array({size, units}, kernel)},
                          {"bias", pack::array({units}, bias)},
                          {"out", pack::array({units}, out)},
                          {"offset", pack::array({1}, offset)}};
    bool found = put(familiarity, key, bytes);
    Fields prior = {{"incumbent", pack::text("hand-set")},
                    {"low", pack::real(low)},
                    {"high", pack::real(high)},
                    {"familiarity", pack::map(familiarity)}};
    found = put(prior, key, bytes) || found || key == "gain" || key.empty();
    if (!found) prior.push_back({key, bytes});
    const std::string told =
        key == "gain" ? bytes : pack::array({example.samples}, gains());
    Fields body = example.body();
    put(body, "prior_cost", pack::map(prior));
    put(body, "samples", example.sample_fields(told));
    return pack::sealed(pack::map(body));
  }

  std::string file() const { return tampered(); }

  static bool put(Fields& fields, const std::string& key, const std::string& bytes) {
    for (auto& field : fields) {
      if (field.first != key) continue;
      field.second = bytes;
      return true;
    }
    return false;
  }
};

constexpr std::size_t kStationTimes = 18;
constexpr float kStationDt = 8.0f / 17.0f;

// A file that reads the station alone, on the usual times, and likes the furthest.
inline Example likes_speed() {
  Example example(1, kStationTimes, {}, "identity", false);
  example.lower = {-1e6f};
  example.upper = {1e6f};
  example.location = {0.0f};
  example.scale = {1.0f};
  example.gamma.assign(kStationTimes, 1.0f);
  example.kernels = {{1.0f}};
  example.biases = {{0.0f}};
  return example;
}

inline std::string with_station(const Example& example, Fields fields) {
  std::vector<float> times;
  for (std::size_t t = 0; t < kStationTimes; ++t) times.push_back(kStationDt * static_cast<float>(t));
  const std::string station = pack::map({{"name", pack::text("station")},
                                         {"unit", pack::text("m")},
                                         {"none_value", pack::real(0.0)}});
  WithPriorCost::put(fields, "features", pack::list({station}));
  WithPriorCost::put(fields, "times", pack::array({example.times}, times));
  return pack::sealed(pack::map(fields));
}

// The same on a prior cost, with one gain everywhere.
inline std::string with_gain(const Example& example, float gain) {
  const auto one = [](float value) { return pack::array({1}, {value}); };
  Fields fields = example.body();
  const std::string familiarity =
      pack::map({{"location", one(0.0f)},
                 {"scale", one(1.0f)},
                 {"kernel", pack::array({1, 1}, {0.0f})},
                 {"bias", one(0.0f)},
                 {"out", one(0.0f)},
                 {"offset", one(0.0f)}});
  WithPriorCost::put(fields, "prior_cost",
                     pack::map({{"incumbent", pack::text("hand-set")},
                                {"low", pack::real(double{gain})},
                                {"high", pack::real(double{gain})},
                                {"familiarity", familiarity}}));
  WithPriorCost::put(fields, "samples",
                     example.sample_fields(pack::filled({example.samples}, gain)));
  return with_station(example, fields);
}

#endif  // RCIRL_TESTS_WITH_PRIOR_COST_HPP_
