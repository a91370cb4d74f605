// choose WEIGHTS < CANDIDATES: the candidate that the learned reward likes best.
//
// CANDIDATES is float32 numbers in this machine's byte order, [K, T, F] with the last
// axis fastest; the sizes T and F are those of the weights file.
#include <cstdio>
#include <vector>

#include "rcirl/reward.hpp"

int main(int count, char** arguments) {
  if (count != 2) {
    std::fprintf(stderr, "choose: %d arguments: expected WEIGHTS\n", count - 1);
    return 2;
  }
  rcirl::Reward reward;
  const rcirl::Status status = rcirl::load(arguments[1], &reward);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  if (reward.anchored()) {
    std::fprintf(stderr, "%s: anchor: %s: expected a reward that is not added to another\n",
                 arguments[1], reward.incumbent().c_str());
    return 2;
  }
  std::vector<float> features, chunk(1 << 16);
  for (std::size_t read; (read = std::fread(chunk.data(), 4, chunk.size(), stdin)) > 0;) {
    features.insert(features.end(), chunk.begin(), chunk.begin() + static_cast<long>(read));
  }
  const std::size_t row = reward.times().size() * reward.features().size();
  if (features.empty() || features.size() % row != 0) {
    std::fprintf(stderr, "stdin: candidates: %zu numbers: expected a multiple of %zu\n",
                 features.size(), row);
    return 2;
  }
  const std::size_t candidates = features.size() / row;
  rcirl::Workspace workspace = reward.workspace();
  std::vector<float> values(candidates);
  const std::size_t refused =
      reward.score(features.data(), candidates, {}, &workspace, values.data());
  const std::size_t best = rcirl::best(values.data(), candidates);
  if (best == candidates) {
    std::fprintf(stderr, "stdin: candidates: all %zu refused: expected finite features\n", refused);
    return 1;
  }
  std::printf("candidate %zu of %zu, value %.9g, %zu refused\n", best, candidates,
              static_cast<double>(values[best]), refused);
  return 0;
}
