// Weights files made in memory, and their score in plain double loops.
#ifndef RCIRL_TESTS_FILES_HPP_
#define RCIRL_TESTS_FILES_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "rcirl/detail/sha256.hpp"

// msgpack values, each as its bytes.
namespace pack {

inline std::string big_endian(std::uint64_t value, int bytes) {
  std::string text;
  for (int i = bytes - 1; i >= 0; --i) text += static_cast<char>(value >> (8 * i));
  return text;
}

inline std::string sized(char tag, std::size_t size) { return tag + big_endian(size, 4); }
inline std::string nil() { return "\xc0"; }
inline std::string boolean(bool value) { return value ? "\xc3" : "\xc2"; }
inline std::string natural(std::uint64_t value) { return '\xcf' + big_endian(value, 8); }
inline std::string text(const std::string& value) { return sized('\xdb', value.size()) + value; }
inline std::string bytes(const std::string& value) { return sized('\xc6', value.size()) + value; }

inline std::string real(double value) {
  std::uint64_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  return '\xcb' + big_endian(bits, 8);
}

inline std::string list(const std::vector<std::string>& items) {
  std::string all = sized('\xdd', items.size());
  for (const std::string& item : items) all += item;
  return all;
}

inline std::string map(const std::vector<std::pair<std::string, std::string>>& items) {
  std::string all = sized('\xdf', items.size());
  for (const auto& [key, value] : items) all += text(key) + value;
  return all;
}

inline std::string array(const std::vector<std::size_t>& shape, const std::vector<float>& values) {
  std::vector<std::string> axes;
  for (const std::size_t axis : shape) axes.push_back(natural(axis));
  std::string data(4 * values.size(), '\0');
  if (!values.empty()) std::memcpy(data.data(), values.data(), data.size());
  return map({{"shape", list(axes)}, {"dtype", text("<f4")}, {"data", bytes(data)}});
}

// An array of `shape` filled with one number.
inline std::string filled(const std::vector<std::size_t>& shape, float value) {
  std::size_t size = 1;
  for (const std::size_t axis : shape) size *= axis;
  return array(shape, std::vector<float>(size, value));
}

// A file with this body and the right hash.
inline std::string sealed(const std::string& body) {
  return map({{"magic", text("RCIRLW")},
              {"schema_version", natural(1)},
              {"body", bytes(body)},
              {"sha256", text(rcirl::detail::sha256_hex(body.data(), body.size()))}});
}

}  // namespace pack

// A random reward; the fields stand in `body()` and may be replaced by other bytes.
struct Example {
  std::size_t features = 3, times = 4, samples = 3;
  std::vector<std::size_t> hidden = {5};
  std::string activation = "tanh";
  bool scene_gating = false;
  unsigned seed = 0;
  double gain = 0.0;                 // on the prior cost "hand-set"; 0: no prior cost
  std::string column0 = "feature0";  // name of the first column, in m
  float step = 0.5f;                 // s between times

  std::vector<float> lower, upper, location, scale, gamma, gates;
  std::vector<std::vector<float>> kernels, biases;

  Example() { draw(); }
  Example(std::size_t f, std::size_t t, std::vector<std::size_t> h, std::string a, bool c)
      : features(f), times(t), hidden(std::move(h)), activation(std::move(a)), scene_gating(c) {
    draw();
  }

  void draw() {
    std::mt19937 random(seed);
    const auto normal = [&random](std::size_t size, double sigma) {
      std::normal_distribution<double> draw(0.0, sigma);
      std::vector<float> values(size);
      for (float& value : values) value = static_cast<float>(draw(random));
      return values;
    };
    lower = std::vector<float>(features, -1.5f);
    upper = std::vector<float>(features, 1.25f);
    location = normal(features, 0.5);
    scale = normal(features, 0.1);
    for (float& value : scale) value += 1.0f;
    gamma = normal(times, 1.0 / std::sqrt(static_cast<double>(times)));
    if (scene_gating) gates = normal(features * features, 0.5);
    std::size_t in = features;
    for (std::size_t i = 0; i <= hidden.size(); ++i) {
      const std::size_t out = i < hidden.size() ? hidden[i] : 1;
      kernels.push_back(normal(in * out, 1.0 / std::sqrt(static_cast<double>(in))));
      biases.push_back(normal(out, 0.1));
      in = out;
    }
  }

  // Raw features [count, T, F]; many leave [lower, upper].
  std::vector<float> inputs(std::size_t count, unsigned key) const {
    std::mt19937 random(key);
    std::normal_distribution<double> draw(0.0, 1.5);
    std::vector<float> values(count * times * features);
    for (float& value : values) value = static_cast<float>(draw(random));
    return values;
  }

  double act(double x) const {
    if (activation == "tanh") return std::tanh(x);
    if (activation == "relu") return std::max(x, 0.0);
    if (activation == "leaky_relu") return x > 0.0 ? x : 0.01 * x;
    return x;
  }

  std::vector<double> normalised(const float* row) const {
    std::vector<double> x(features);
    for (std::size_t f = 0; f < features; ++f) {
      const float clipped = std::min(std::max(row[f], lower[f]), upper[f]);
      x[f] = (double{clipped} - double{location[f]}) / double{scale[f]};
    }
    return x;
  }

  // V of one trajectory [T, F]; `valid` [T] or null.
  double value(const float* trajectory, const std::uint8_t* valid) const {
    std::vector<double> gains(features, 1.0);
    const std::vector<double> first = normalised(trajectory);
    for (std::size_t j = 0; j < features && scene_gating; ++j) {
      double sum = 0.0;
      for (std::size_t i = 0; i < features; ++i) {
        sum += first[i] * double{gates[i * features + j]};
      }
      gains[j] = 2.0 / (1.0 + std::exp(-sum));
    }
    double total = 0.0;
    for (std::size_t t = 0; t < times; ++t) {
      if (valid != nullptr && valid[t] == 0) continue;
      std::vector<double> x = normalised(trajectory + t * features);
      for (std::size_t f = 0; f < features; ++f) x[f] *= gains[f];
      for (std::size_t layer = 0; layer < kernels.size(); ++layer) {
        const std::size_t out = biases[layer].size();
        std::vector<double> y(biases[layer].begin(), biases[layer].end());
        for (std::size_t j = 0; j < out; ++j) {
          for (std::size_t i = 0; i < x.size(); ++i) {
            y[j] += x[i] * double{kernels[layer][i * out + j]};
          }
          if (layer + 1 < kernels.size()) y[j] = act(y[j]);
        }
        x = y;
      }
      total += double{gamma[t]} * x[0];
    }
    return total;
  }

  // The fields of the body in the writer's order; replace what a test needs.
  std::vector<std::pair<std::string, std::string>> body() const {
    const std::size_t size = features;
    std::vector<std::string> columns, layers;
    for (std::size_t f = 0; f < size; ++f) {
      columns.push_back(f == 0 ? column(column0, "m")
                               : column("feature" + std::to_string(f), "m/s\u00b2"));
    }
    std::size_t in = size;
    for (std::size_t i = 0; i < kernels.size(); ++i) {
      const std::size_t out = biases[i].size();
      layers.push_back(pack::map({{"kernel", pack::array({in, out}, kernels[i])},
                                  {"bias", pack::array({out}, biases[i])}}));
      in = out;
    }
    std::vector<float> grid(times);
    for (std::size_t t = 0; t < times; ++t) grid[t] = step * static_cast<float>(t);
    std::vector<float> ends(2 * size, 1.0f);  // of the training's range
    std::fill_n(ends.begin(), size, -1.0f);
    const std::vector<float> raw = inputs(samples, seed + 1);
    std::vector<float> values(samples);
    for (std::size_t i = 0; i < samples; ++i) {
      values[i] = static_cast<float>(value(&raw[i * times * size], nullptr));
    }
    return {
        {"preset", pack::text("test")},
        {"features", pack::list(columns)},
        {"normaliser", pack::map({{"lower", pack::array({size}, lower)},
                                  {"upper", pack::array({size}, upper)},
                                  {"location", pack::array({size}, location)},
                                  {"scale", pack::array({size}, scale)}})},
        {"training_range", pack::array({2, size}, ends)},
        {"times", pack::array({times}, grid)},
        {"gamma", pack::array({times}, gamma)},
        {"layers", pack::list(layers)},
        {"activation", pack::text(activation)},
        {"leaky_slope", pack::real(0.01)},
        {"scene_gating", scene_gating ? pack::array({size, size}, gates) : pack::nil()},
        {"prior_cost", gain > 0.0 ? prior_cost(pack::real(gain)) : pack::nil()},
        {"loss", pack::map({{"name", pack::text("rank")}, {"leaky_rate", pack::nil()}})},
        {"provenance", pack::map({{"seed", pack::natural(7)}})},
        {"samples", pack::map({{"features", pack::array({samples, times, size}, raw)},
                               {"valid", pack::filled({samples, times}, 1.0f)},
                               {"value", pack::array({samples}, values)}})}};
  }

  static std::string prior_cost(const std::string& gain,
                                const std::string& incumbent = pack::text("hand-set")) {
    return pack::map({{"incumbent", incumbent}, {"gain", gain}});
  }

  static std::string column(const std::string& name, const std::string& unit) {
    return pack::map({{"name", pack::text(name)},
                      {"unit", pack::text(unit)},
                      {"none_value", pack::natural(100)}});
  }

  std::string file() const { return pack::sealed(pack::map(body())); }

  // The file with one field replaced (added if it is new), and the right hash.
  std::string tampered(const std::string& key, const std::string& bytes) const {
    auto fields = body();
    const auto at = std::find_if(fields.begin(), fields.end(),
                                 [&key](const auto& field) { return field.first == key; });
    if (at != fields.end()) {
      at->second = bytes;
    } else {
      fields.push_back({key, bytes});
    }
    return pack::sealed(pack::map(fields));
  }
};

// A reward that reads the station alone, on the usual times, and likes the furthest.
inline Example likes_speed() {
  Example example(1, 18, {}, "identity", false);
  example.column0 = "station";
  example.step = 8.0f / 17.0f;
  example.lower = {-1e6f};
  example.upper = {1e6f};
  example.location = {0.0f};
  example.scale = {1.0f};
  example.gamma.assign(example.times, 1.0f);
  example.kernels = {{1.0f}};
  example.biases = {{0.0f}};
  return example;
}

#endif  // RCIRL_TESTS_FILES_HPP_
