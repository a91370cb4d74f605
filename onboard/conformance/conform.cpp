// conform WEIGHTS < CASE: features and scores of one case of cases.txt, by these headers.
//
// Writes K * T * F features and K scores; README.md says how a case reads.
#include <cstdio>
#include <vector>

#include "../tests/flat.hpp"
#include "rcirl/features.hpp"

int main(int count, char** arguments) {
  rcirl::Reward reward;
  rcirl::FeatureMap columns;
  rcirl::Status status = count == 2 ? rcirl::load(arguments[1], &reward)
                                    : rcirl::Status("conform: arguments: expected WEIGHTS");
  if (status.ok()) status = rcirl::feature_map(reward, &columns);
  Case one;
  Words words = {stdin};
  if (status.ok() && !take_case(words, &one)) {
    status = rcirl::Status("stdin: case: expected the lines that README.md names");
  }
  if (status.ok()) status = rcirl::check(one.scene);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  const rcirl::Candidates candidates = one.candidates();
  std::vector<float> features(candidates.count * rcirl::kTimes * columns.size());
  std::vector<float> scores(candidates.count);
  columns.compute(one.scene, candidates, features.data());
  rcirl::Workspace workspace = reward.workspace();
  reward.score(features.data(), candidates.count, columns.mask(one.scene), &workspace,
               scores.data());
  for (const float value : features) std::printf("%.9g\n", static_cast<double>(value));
  for (const float value : scores) std::printf("%.9g\n", static_cast<double>(value));
  return 0;
}
