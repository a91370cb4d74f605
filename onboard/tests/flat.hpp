// A case of the conformance file: a scene and candidates as numbers in a fixed order.
//
// `source(label, count, out)` gives the next numbers; a text names them by the label.
#ifndef RCIRL_TESTS_FLAT_HPP_
#define RCIRL_TESTS_FLAT_HPP_

#include <array>
#include <cstdio>
#include <cstring>
#include <string>
#include <vector>

#include "rcirl/features.hpp"

constexpr float kMostListed = 4096.0f;  // obstacles or candidates of a case

struct Case {
  rcirl::Scene scene;
  bool on_path = true;
  std::vector<float> s, l;  // [K, T]

  rcirl::Candidates candidates() const {
    return {s.data(), on_path ? nullptr : l.data(), s.size() / rcirl::kTimes};
  }
};

template <typename Source, std::size_t kSize>
bool take(Source& source, const char* label, std::array<float, kSize>* out) {
  return source(label, kSize, out->data());
}

template <typename Source>
bool take_count(Source& source, const char* label, std::size_t* out) {
  float number;
  if (!source(label, 1, &number) || !(number >= 0.0f && number <= kMostListed)) return false;
  *out = static_cast<std::size_t>(number);
  return true;
}

template <typename Source>
bool take_obstacle(Source& source, rcirl::Obstacle* box) {
  std::size_t kind;
  rcirl::Times valid;
  if (!take_count(source, "kind", &kind) || kind > 6) return false;
  box->kind = static_cast<rcirl::ObstacleKind>(kind);
  if (!take(source, "s_lower", &box->s_lower) || !take(source, "s_upper", &box->s_upper) ||
      !take(source, "l_lower", &box->l_lower) || !take(source, "l_upper", &box->l_upper) ||
      !take(source, "speed", &box->speed) || !take(source, "valid", &valid)) {
    return false;
  }
  for (std::size_t t = 0; t < rcirl::kTimes; ++t) box->valid[t] = valid[t] != 0.0f;
  return true;
}

template <typename Source>
bool take_case(Source& source, Case* found) {
  std::array<float, 8> e;
  rcirl::Scene& scene = found->scene;
  std::size_t count, on_path;
  if (!take(source, "ego", &e)) return false;
  scene.ego = {e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7]};
  if (!take(source, "kappa", &scene.path.kappa) || !take(source, "path_l", &scene.path.l) ||
      !take(source, "speed_limit", &scene.path.speed_limit) ||
      !take(source, "road_left", &scene.path.road_left) ||
      !take(source, "road_right", &scene.path.road_right) ||
      !take_count(source, "num_valid", &scene.num_valid) ||
      !take_count(source, "obstacles", &count)) {
    return false;
  }
  scene.obstacles.assign(count, {});
  for (rcirl::Obstacle& box : scene.obstacles) {
    if (!take_obstacle(source, &box)) return false;
  }
  if (!take_count(source, "candidates", &count) || !take_count(source, "on_path", &on_path)) {
    return false;
  }
  found->on_path = on_path != 0;
  found->s.assign(count * rcirl::kTimes, 0.0f);
  found->l = found->s;
  for (std::size_t k = 0; k < count; ++k) {
    if (!source("s", rcirl::kTimes, &found->s[k * rcirl::kTimes])) return false;
    if (!found->on_path && !source("l", rcirl::kTimes, &found->l[k * rcirl::kTimes])) return false;
  }
  return true;
}

// Labels and numbers of a text.
struct Words {
  std::FILE* stream;

  bool operator()(const char* label, std::size_t count, float* out) {
    char word[64];
    if (std::fscanf(stream, "%63s", word) != 1 || std::strcmp(word, label) != 0) return false;
    for (std::size_t i = 0; i < count; ++i) {
      if (std::fscanf(stream, "%f", &out[i]) != 1) return false;
    }
    return true;
  }
};

// The same numbers without labels, as float32.
struct Numbers {
  const float *at, *end;

  bool operator()(const char*, std::size_t count, float* out) {
    if (static_cast<std::size_t>(end - at) < count) return false;
    std::copy(at, at + count, out);
    at += count;
    return true;
  }
};

#endif  // RCIRL_TESTS_FLAT_HPP_
