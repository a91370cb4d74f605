// choose WEIGHTS [COSTS] < CANDIDATES: the candidate that the learned reward likes best.
//
// CANDIDATES is float32 numbers in this machine's byte order, [K, T, F] with the last
// axis fastest; the sizes T and F are those of the weights file. COSTS is [K] alike, the
// planner's own costs, lower is better: a reward with a prior cost is added to them.
#include <cstdio>
#include <vector>

#include "rcirl/reward.hpp"

namespace {

std::vector<float> numbers(std::FILE* file) {
  std::vector<float> all, chunk(1 << 16);
  for (std::size_t read; (read = std::fread(chunk.data(), 4, chunk.size(), file)) > 0;) {
    all.insert(all.end(), chunk.begin(), chunk.begin() + static_cast<long>(read));
  }
  return all;
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 2 && count != 3) {
    std::fprintf(stderr, "choose: %d arguments: expected WEIGHTS [COSTS]\n", count - 1);
    return 2;
  }
  rcirl::Reward reward;
  const rcirl::Status status = rcirl::load(arguments[1], &reward);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  if (reward.has_prior_cost() != (count == 3)) {
    std::fprintf(stderr, "%s: prior_cost: %s: expected %s\n", arguments[1],
                 reward.has_prior_cost() ? reward.incumbent().c_str() : "none",
                 reward.has_prior_cost() ? "COSTS as a second argument, those of the planner"
                                   : "no COSTS, for the reward decides alone");
    return 2;
  }
  const std::vector<float> features = numbers(stdin);
  const std::size_t row = reward.times().size() * reward.features().size();
  if (features.empty() || features.size() % row != 0) {
    std::fprintf(stderr, "stdin: candidates: %zu numbers: expected a multiple of %zu\n",
                 features.size(), row);
    return 2;
  }
  const std::size_t candidates = features.size() / row;
  rcirl::Workspace workspace = reward.workspace();
  std::vector<float> values(candidates);
  std::size_t refused = 0;
  if (reward.has_prior_cost()) {
    std::FILE* file = std::fopen(arguments[2], "rb");
    std::vector<float> own = file != nullptr ? numbers(file) : std::vector<float>();
    if (file != nullptr) std::fclose(file);
    if (own.size() != candidates) {
      std::fprintf(stderr, "%s: costs: %zu numbers: expected %zu\n", arguments[2], own.size(),
                   candidates);
      return 2;
    }
    for (float& cost : own) cost = -cost;
    refused = reward.total(features.data(), candidates, {}, own.data(), &workspace, values.data());
  } else {
    refused = reward.score(features.data(), candidates, {}, &workspace, values.data());
  }
  const std::size_t best = rcirl::best(values.data(), candidates);
  if (best == candidates) {
    std::fprintf(stderr, "stdin: candidates: all %zu refused: expected finite features\n", refused);
    return 1;
  }
  std::printf("candidate %zu of %zu, value %.9g, %zu refused\n", best, candidates,
              static_cast<double>(values[best]), refused);
  return 0;
}
