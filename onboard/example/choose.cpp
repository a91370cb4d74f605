// choose WEIGHTS ADMISSIBLE [COSTS] < CANDIDATES: the admissible candidate of the best value,
// for a planner with features and a safety filter of its own.
//
// ADMISSIBLE is K bytes of that filter, 1 for a candidate that may be driven, else 0: a value
// says nothing of safety. CANDIDATES is float32 numbers in this machine's byte order,
// [K, T, F] with the last axis fastest; the sizes T and F are those of the weights file. COSTS
// is [K] alike, the planner's own costs, lower is better: a reward with a prior cost is added
// to them. Without a filter of your own: own_planner.cpp.
#include <cstdint>
#include <cstdio>
#include <vector>

#include "rcirl/reward.hpp"

namespace {

template <typename Number>
std::vector<Number> numbers(std::FILE* file) {
  std::vector<Number> all, chunk(1 << 16);
  for (std::size_t read;
       (read = std::fread(chunk.data(), sizeof(Number), chunk.size(), file)) > 0;) {
    all.insert(all.end(), chunk.begin(), chunk.begin() + static_cast<long>(read));
  }
  return all;
}

template <typename Number>
std::vector<Number> numbers(const char* path) {
  std::FILE* file = std::fopen(path, "rb");
  if (file == nullptr) return {};
  const std::vector<Number> all = numbers<Number>(file);
  std::fclose(file);
  return all;
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 3 && count != 4) {
    std::fprintf(stderr, "choose: %d arguments: expected WEIGHTS ADMISSIBLE [COSTS]\n", count - 1);
    return 2;
  }
  rcirl::Reward reward;
  const rcirl::Status status = rcirl::load(arguments[1], &reward);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  if (reward.has_prior_cost() != (count == 4)) {
    std::fprintf(stderr, "%s: prior_cost: %s: expected %s\n", arguments[1],
                 reward.has_prior_cost() ? reward.incumbent().c_str() : "none",
                 reward.has_prior_cost() ? "COSTS as a third argument, those of the planner"
                                   : "no COSTS, for the reward decides alone");
    return 2;
  }
  const std::vector<float> features = numbers<float>(stdin);
  const std::size_t row = reward.times().size() * reward.features().size();
  if (features.empty() || features.size() % row != 0) {
    std::fprintf(stderr, "stdin: candidates: %zu numbers: expected a multiple of %zu\n",
                 features.size(), row);
    return 2;
  }
  const std::size_t candidates = features.size() / row;
  const std::vector<std::uint8_t> admissible = numbers<std::uint8_t>(arguments[2]);
  if (admissible.size() != candidates) {
    std::fprintf(stderr, "%s: admissible: %zu bytes: expected %zu\n", arguments[2],
                 admissible.size(), candidates);
    return 2;
  }
  rcirl::Workspace workspace = reward.workspace();
  std::vector<float> values(candidates);
  std::size_t refused = 0;
  if (reward.has_prior_cost()) {
    std::vector<float> own = numbers<float>(arguments[3]);
    if (own.size() != candidates) {
      std::fprintf(stderr, "%s: costs: %zu numbers: expected %zu\n", arguments[3], own.size(),
                   candidates);
      return 2;
    }
    for (float& cost : own) cost = -cost;
    refused = reward.total(features.data(), candidates, {}, own.data(), &workspace, values.data());
  } else {
    refused = reward.score(features.data(), candidates, {}, &workspace, values.data());
  }
  const std::size_t best = rcirl::best(values.data(), candidates, admissible.data());
  if (best == candidates) {
    std::fprintf(stderr,
                 "stdin: candidates: none of %zu is admissible and has a value, %zu refused: "
                 "brake\n",
                 candidates, refused);
    return 1;
  }
  std::printf("candidate %zu of %zu, value %.9g, %zu refused\n", best, candidates,
              static_cast<double>(values[best]), refused);
  return 0;
}
