// The score of docs/weights_format.md, 32 candidates side by side.
//
//   x_t = (clip(f_t, lower, upper) - location) / scale
//   x_t <- x_t * 2 / (1 + exp(-x_0 C))                    with scene gating only
//   r_t = act(... act(x_t W_0 + b_0) ...) W_{L-1} + b_{L-1}
//   V   = sum over valid t of gamma_t r_t
//
// Nothing here allocates. Plain loops of constant length over the lanes: compilers
// turn them into vector instructions (GCC from -O2 in version 12, best at -O3).
#ifndef RCIRL_DETAIL_NETWORK_HPP_
#define RCIRL_DETAIL_NETWORK_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "rcirl: NaN must be seen: compile without -ffast-math or with -fno-finite-math-only"
#endif

namespace rcirl::detail {

constexpr std::size_t kLanes = 32;  // candidates of a block

struct alignas(64) Lanes {
  float at[kLanes];
};

enum class Activation : std::uint8_t { kTanh, kRelu, kLeakyRelu, kIdentity };

struct Layer {
  std::size_t in = 0, out = 0;
  std::vector<float> kernel;  // [in, out]
  std::vector<float> bias;    // [out]
};

struct Network {
  std::size_t features = 0;                         // F
  std::vector<float> lower, upper, location, scale;  // [F]
  std::vector<float> gamma;                          // [T]
  std::vector<float> scene_gating;                   // [F, F], or empty
  std::vector<Layer> layers;                         // F -> ... -> 1
  Activation activation = Activation::kIdentity;
  float leaky_slope = 0.0f;

  std::size_t times() const { return gamma.size(); }

  std::size_t width() const {
    std::size_t most = features;
    for (const Layer& layer : layers) most = std::max(most, layer.out);
    return most;
  }

  // Lanes that `score` works in: the inputs and outputs of a layer, and the gates.
  std::size_t work_size() const { return 2 * width() + (scene_gating.empty() ? 0 : features); }
};

// [T] (stride 0) or [K, T] (stride T) of 0 and 1; no data: every time is valid.
struct Valid {
  const std::uint8_t* data = nullptr;
  std::size_t stride = 0;
};

// tanh as an odd rational function, x P(x^2) / Q(x^2), 1 from |x| = 9.02 on. Off by
// 4e-7 at most, absolute and relative, in float32 (fitted to 2.1e-8). NaN stays NaN.
// Two loops: GCC does not vectorise one whose clamp decides a constant result.
inline void tanh_lanes(float* x) {
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float c = x[k] < -9.02f ? -9.02f : x[k];
    x[k] = c > 9.02f ? 9.02f : c;
  }
  for (std::size_t k = 0; k < kLanes; ++k) {
    const float z = x[k] * x[k];
    float p = 1.3319096e-8f, q = 7.7620311e-7f;
    p = p * z + 2.0583505e-5f;
    q = q * z + 3.2830954e-4f;
    p = p * z + 3.4940362e-3f;
    q = q * z + 2.5871079e-2f;
    p = p * z + 1.3379719e-1f;
    q = q * z + 4.6713035e-1f;
    p = p * z + 9.9999998e-1f;
    q = q * z + 1.0f;
    x[k] = x[k] * p / q;
  }
}

// N outputs of x W + b: y[n] = bias[n] + sum over i of x[i] kernel[i * out + n].
template <std::size_t N>
void dense_tile(const Lanes* x, std::size_t in, const float* kernel, const float* bias,
                std::size_t out, Lanes* y) {
  float sum[N][kLanes];
  for (std::size_t n = 0; n < N; ++n) {
    for (std::size_t k = 0; k < kLanes; ++k) sum[n][k] = bias[n];
  }
  for (std::size_t i = 0; i < in; ++i) {
    for (std::size_t n = 0; n < N; ++n) {
      const float weight = kernel[i * out + n];
      for (std::size_t k = 0; k < kLanes; ++k) sum[n][k] += weight * x[i].at[k];
    }
  }
  for (std::size_t n = 0; n < N; ++n) {
    for (std::size_t k = 0; k < kLanes; ++k) y[n].at[k] = sum[n][k];
  }
}

inline void dense(const Lanes* x, const Layer& layer, Lanes* y) {
  constexpr std::size_t kTile = 3;  // outputs whose sums stay in registers
  const float *kernel = layer.kernel.data(), *bias = layer.bias.data();
  std::size_t n = 0;
  for (; n + kTile <= layer.out; n += kTile) {
    dense_tile<kTile>(x, layer.in, kernel + n, bias + n, layer.out, y + n);
  }
  for (; n < layer.out; ++n) {
    dense_tile<1>(x, layer.in, kernel + n, bias + n, layer.out, y + n);
  }
}

// In place; every branch keeps a NaN.
inline void activate(const Network& network, Lanes* x, std::size_t size) {
  const float slope = network.leaky_slope;
  for (std::size_t i = 0; i < size; ++i) {
    float* lanes = x[i].at;
    switch (network.activation) {
      case Activation::kTanh:
        tanh_lanes(lanes);
        break;
      case Activation::kRelu:
        for (std::size_t k = 0; k < kLanes; ++k) {
          lanes[k] = lanes[k] < 0.0f ? 0.0f : lanes[k];
        }
        break;
      case Activation::kLeakyRelu:
        for (std::size_t k = 0; k < kLanes; ++k) {
          const float scaled = slope * lanes[k];
          lanes[k] = lanes[k] > 0.0f ? lanes[k] : scaled;
        }
        break;
      case Activation::kIdentity:
        break;
    }
  }
}

// x[f] = normalised feature f at one time; `rows[k]` is candidate k's first feature.
inline void normalise(const Network& network, const float* const* rows, Lanes* x) {
  const std::size_t size = network.features;
  for (std::size_t k = 0; k < kLanes; ++k) {
    for (std::size_t f = 0; f < size; ++f) x[f].at[k] = rows[k][f];
  }
  for (std::size_t f = 0; f < size; ++f) {
    const float lower = network.lower[f], upper = network.upper[f];
    const float location = network.location[f], scale = network.scale[f];
    for (std::size_t k = 0; k < kLanes; ++k) {
      float v = x[f].at[k] < lower ? lower : x[f].at[k];
      v = v > upper ? upper : v;
      x[f].at[k] = (v - location) / scale;
    }
  }
}

// Whether V knows a scene, from the raw features [F] of one trajectory at the first time: those
// without effect, which never varied in training, are within their scale of their location.
inline bool knows(const Network& network, const float* first) {
  for (std::size_t f = 0; f < network.features; ++f) {
    const bool empty = network.lower[f] >= network.upper[f];
    if (empty && std::abs(first[f] - network.location[f]) > network.scale[f]) return false;
  }
  return true;
}

// gates = 2 / (1 + exp(-x C)), [F].
inline void feature_gates(const Network& network, const Lanes* x, Lanes* gates) {
  const std::size_t size = network.features;
  for (std::size_t j = 0; j < size; ++j) {
    float sum[kLanes] = {};
    for (std::size_t i = 0; i < size; ++i) {
      const float weight = network.scene_gating[i * size + j];
      for (std::size_t k = 0; k < kLanes; ++k) sum[k] += weight * x[i].at[k];
    }
    for (std::size_t k = 0; k < kLanes; ++k) {
      gates[j].at[k] = 2.0f / (1.0f + std::exp(-sum[k]));
    }
  }
}

// The layers; returns where the one output lies. Overwrites both buffers.
inline const Lanes* forward(const Network& network, Lanes* x, Lanes* y) {
  for (const Layer& layer : network.layers) {
    dense(x, layer, y);
    if (&layer != &network.layers.back()) activate(network, y, layer.out);
    std::swap(x, y);
  }
  return x;
}

// V of up to 32 candidates, -infinity for one that has none. `features` [count, T, F].
inline void score_block(const Network& network, const float* features, std::size_t count,
                        Valid valid, Lanes* work, float* values) {
  const std::size_t times = network.times(), size = network.features;
  Lanes *x = work, *y = work + network.width(), *gates = y + network.width();
  double total[kLanes] = {};
  bool refused[kLanes] = {};
  for (std::size_t t = 0; t < times; ++t) {
    const float* rows[kLanes];
    bool counts[kLanes], any = false;
    for (std::size_t k = 0; k < kLanes; ++k) {
      const std::size_t lane = std::min(k, count - 1);  // the last one fills the block
      rows[k] = features + (lane * times + t) * size;
      const unsigned mark = valid.data ? valid.data[lane * valid.stride + t] : 1u;
      counts[k] = mark == 1;
      refused[k] |= mark > 1 || (mark == 0 && t == 0 && !network.scene_gating.empty());
      any |= counts[k];
    }
    if (!any) continue;
    normalise(network, rows, x);
    if (!network.scene_gating.empty()) {
      if (t == 0) feature_gates(network, x, gates);
      for (std::size_t f = 0; f < size; ++f) {
        for (std::size_t k = 0; k < kLanes; ++k) x[f].at[k] *= gates[f].at[k];
      }
    }
    const Lanes* reward = forward(network, x, y);
    const double gamma = static_cast<double>(network.gamma[t]);
    for (std::size_t k = 0; k < kLanes; ++k) {
      const double term = gamma * static_cast<double>(reward->at[k]);
      total[k] += counts[k] ? term : 0.0;
    }
  }
  for (std::size_t k = 0; k < count; ++k) {
    const bool finite = std::abs(total[k]) <= double{std::numeric_limits<float>::max()};
    values[k] = finite && !refused[k] ? static_cast<float>(total[k])
                                      : -std::numeric_limits<float>::infinity();
  }
}

// `features` [K, T, F] and `valid` to `values` [K]; `work` is `work_size()` lanes.
inline void score(const Network& network, const float* features, std::size_t count,
                  Valid valid, Lanes* work, float* values) {
  const std::size_t row = network.times() * network.features;
  for (std::size_t first = 0; first < count; first += kLanes) {
    const std::size_t lanes = std::min(kLanes, count - first);
    Valid shifted = valid;
    if (valid.data != nullptr) shifted.data += first * valid.stride;
    score_block(network, features + first * row, lanes, shifted, work, values + first);
  }
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_NETWORK_HPP_
