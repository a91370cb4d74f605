// conform WEIGHTS < CASE: features, scores and rulings of one case, by these headers.
//
// Writes K * T * F features, K scores, and reason, obstacle and time of K rulings; README.md
// says how a case reads.
#include <cmath>
#include <cstdio>
#include <vector>

#include "../tests/flat.hpp"
#include "rcirl/features.hpp"
#include "rcirl/safety.hpp"

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
  std::vector<rcirl::Ruling> rulings(candidates.count);
  rcirl::SafetyLimits limits;
  limits.entry = candidates.l != nullptr;
  rcirl::admit(one.scene, candidates, limits, rulings.data());
  for (const rcirl::Ruling& ruling : rulings) {
    const bool named = ruling.obstacle != rcirl::Ruling::kNobody;
    const double time = std::isfinite(ruling.time) ? static_cast<double>(ruling.time) : -1.0;
    std::printf("%d %d %.9g\n", static_cast<int>(ruling.reason),
                named ? static_cast<int>(ruling.obstacle) : -1, time);
  }
  return 0;
}
